"""A report.html as browsers show it, to PNGs: light and dark, wide and as on a phone, sorted, filtered, a row open.

    python scripts/look_at_report.py REPORT.html OUT_FOLDER [--browser /usr/bin/chromium]

Needs `pip install playwright` and a Chromium (apt-get install chromium). Prints how long the first row takes to show,
and everything the browser complains about; exits with 1 if it does, or if the page asks for anything but itself.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from playwright.sync_api import Page, sync_playwright

WIDE, NARROW = (1280, 900), (400, 800)
PAINT_MS = 300

Look = tuple[str, tuple[int, int], str, Callable[[Page], Any]]


def open_first(page: Page) -> None:
    page.locator("#rows [aria-expanded=false]").first.click()


def sort_by_error(page: Page) -> None:
    page.locator("[data-key=expected_error_px] button").click()


def only_rejected(page: Page) -> None:
    rejected = page.locator("[data-status=rejected]")
    if rejected.is_enabled():  # there are some
        rejected.click()
        open_first(page)


def show_worst(page: Page) -> None:
    page.locator("[data-show]").click()


def slide_by_keyboard(page: Page) -> None:
    show_worst(page)
    for _ in range(25):
        page.locator("input[type=range]").press("ArrowRight")


def blink(page: Page) -> None:
    show_worst(page)
    page.locator("button.blink").click()


def search_by_keyboard(page: Page) -> None:
    page.locator("#search").press_sequentially("a")
    page.keyboard.press("Tab")


LOOKS: tuple[Look, ...] = (
    ("light", WIDE, "light", lambda page: None),
    ("dark", WIDE, "dark", lambda page: None),
    ("dark_open", WIDE, "dark", open_first),
    ("light_worst", WIDE, "light", show_worst),
    ("dark_slid", WIDE, "dark", slide_by_keyboard),
    ("light_blinking", WIDE, "light", blink),
    ("light_sorted", WIDE, "light", sort_by_error),
    ("dark_rejected", WIDE, "dark", only_rejected),
    ("light_search", WIDE, "light", search_by_keyboard),
    ("phone_light", NARROW, "light", lambda page: None),
    ("phone_dark_open", NARROW, "dark", open_first),
    ("phone_light_worst", NARROW, "light", show_worst),
)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("report", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--browser", default="/usr/bin/chromium")
    words = parser.parse_args()
    words.folder.mkdir(parents=True, exist_ok=True)
    complaints: list[str] = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=words.browser, args=["--no-sandbox"])
        for name, (width, height), scheme, act in LOOKS:
            page = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            page.on("console", lambda message: complaints.append(message.text))
            page.on("pageerror", lambda error: complaints.append(str(error)))
            page.on("dialog", lambda dialog: (complaints.append("a dialog opened"), dialog.dismiss()))
            page.on("request", lambda request: complaints.extend(stranger(request.url, words.report)))
            page.goto(words.report.resolve().as_uri())
            page.locator("#rows tr").first.wait_for()
            shown_ms = page.evaluate("performance.now()")
            if page.locator("#rows tr.row, [data-show]").count():
                act(page)
            page.wait_for_timeout(PAINT_MS)
            page.screenshot(path=words.folder / f"{name}.png")
            beyond = page.evaluate("document.documentElement.scrollWidth - innerWidth")
            if beyond > 0:
                complaints.append(f"{name}: the page is {beyond} px too wide")
            print(f"{name}: first row within {shown_ms:.0f} ms of opening")
            page.close()
        browser.close()
    print(*complaints, sep="\n", end="\n" if complaints else "")
    return 1 if complaints else 0


def stranger(url: str, report: Path) -> list[str]:
    """A complaint about whatever is not the report itself or a picture in it."""
    own = url.startswith("data:") or url == report.resolve().as_uri()
    return [] if own else [f"the page asked for {url}"]


if __name__ == "__main__":
    sys.exit(main())
