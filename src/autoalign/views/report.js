"use strict";
// The rows of the report: sorted, filtered, and shown by the hundred.
// Names may hold anything: they are only ever set as text, never as markup.

const PER_PAGE = 100;
const BLINK_MS = 600;

const byId = (id) => document.getElementById(id);
const buttons = [...document.querySelectorAll("button[data-status]")];
const rank = Object.fromEntries(buttons.map((button, place) => [button.dataset.status, place]));
const marks = Object.fromEntries(buttons.map((button) => [button.dataset.status, button.dataset.mark]));
const heads = [...document.querySelectorAll("th[data-key]")];
const alphabet = new Intl.Collator("en-GB", { numeric: true });

const rows = [...document.querySelectorAll("script.row")].map((element, place) => {
  const row = JSON.parse(element.textContent);
  row.order = place + 1;
  row.searched = folded([row.name, row.fixed, row.moving, row.reason].join("\n"));
  return row;
});
const inSequence = document.querySelector("[data-sequence]") !== null;
const view = {
  key: inSequence ? "order" : "status",
  descending: !inSequence, // what needs a look first
  status: "",
  words: "",
  page: 0,
  open: new Set(),
};

function folded(text) {
  return text.normalize("NFKC").toLowerCase();
}

function made(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children.filter((child) => child !== null));
  return element;
}

function digits(value, unit = "") {
  if (value === null || value === undefined) return "–";
  const decimals = { maximumSignificantDigits: 3 };
  return value.toLocaleString("en-GB", Math.abs(value) >= 100 ? { maximumFractionDigits: 0 } : decimals) + unit;
}

// Pictures stand in the file as they are; a browser meets them only when a row shows them.
function picture(number, alt = "") {
  const source = `data:image/jpeg;base64,${byId(`p${number}`).textContent}`;
  return made("img", { src: source, alt, decoding: "async" });
}

function value(row, key) {
  return key === "status" ? rank[row.status] : row[key];
}

function compared(a, b) {
  const [x, y] = [value(a, view.key), value(b, view.key)];
  if (x === y) return a.order - b.order;
  if (x === null) return 1; // what is not known comes last either way
  if (y === null) return -1;
  const difference = typeof x === "string" ? alphabet.compare(x, y) : x - y;
  return view.descending ? -difference : difference;
}

function chosen() {
  const words = folded(view.words).split(/\s+/).filter(Boolean);
  return rows
    .filter((row) => !view.status || row.status === view.status)
    .filter((row) => words.every((word) => row.searched.includes(word)))
    .sort(compared);
}

const cells = {
  order: (row) => [row.order],
  thumbnails: (row) =>
    (row.thumbnails ?? []).slice(1).flatMap((number) => (number === null ? [] : [picture(number)])),
  name: (row) => (row.status === "aligned" ? [opener(row)] : [opener(row), why(row)]),
  status: (row) => [status(row)],
  expected_error_px: (row) => [digits(row.expected_error_px, " px")],
  inliers: (row) => [digits(row.inliers)],
  matches: (row) => [digits(row.matches)],
  overlap: (row) => [row.overlap ? digits(100 * row.overlap, " %") : "–"],
  shift_px: (row) => [digits(row.shift_px, " px")],
  model: (row) => [row.model ?? "–"],
};

function opener(row) {
  const button = made("button", { type: "button", className: "link", dir: "auto" }, row.name);
  button.setAttribute("aria-expanded", view.open.has(row.order));
  return button;
}

function why(row) {
  return made("div", { className: "why", dir: "auto" }, row.reason);
}

function status(row) {
  const word = made("span", { className: "word" }, ` ${row.status}`);
  return made("span", { className: `status ${row.status}` }, marks[row.status], word);
}

function line(row) {
  const element = made("tr", { className: "row" });
  for (const head of heads) {
    const key = head.dataset.key;
    const cell = made(key === "name" ? "th" : "td", { className: head.className }, ...cells[key](row));
    if (key === "name") cell.scope = "row";
    element.append(cell);
  }
  element.addEventListener("click", (event) => {
    if (event.target.closest("a") || String(getSelection())) return;
    toggle(row, element);
  });
  return element;
}

function toggle(row, element) {
  if (!view.open.delete(row.order)) view.open.add(row.order);
  const open = view.open.has(row.order);
  element.classList.toggle("open", open);
  element.querySelector("[aria-expanded]").setAttribute("aria-expanded", open);
  if (open) element.after(made("tr", {}, made("td", { colSpan: heads.length }, detail(row))));
  else element.nextElementSibling.remove();
}

function detail(row) {
  const words = made("div", {});
  words.append(
    made("p", { className: `status ${row.status}` }, `${marks[row.status]} ${row.status}`),
    made("p", { dir: "auto" }, row.reason),
  );
  if (row.advice) words.append(made("p", { className: "faint", dir: "auto" }, `What may help: ${row.advice}.`));
  const list = made("dl", { className: "words" });
  const tell = (term, ...told) => list.append(made("dt", {}, term), made("dd", { dir: "auto" }, ...told));
  if (row.expected_error_px !== null) tell("expected error", digits(row.expected_error_px, " px"));
  if (row.matches !== null) tell("matches", `${digits(row.inliers)} of ${digits(row.matches)} agree`);
  if (row.overlap) tell("overlap", `${digits(100 * row.overlap, " %")} of fixed`);
  if (row.motion) tell("moving → fixed", `${row.model ?? "transform"}: ${row.motion}`);
  if (row.fixed_from_moving) tell("transform", matrix(row.fixed_from_moving));
  if (row.rung) tell("effort", row.rung);
  for (const role of ["fixed", "moving"]) tell(role, made("bdi", {}, row[role]), sized(row[`${role}_size`]));
  const links = Object.entries(row.links);
  if (links.length) {
    tell("files", made("span", { className: "links" }, ...links.map(([name, href]) => made("a", { href }, name))));
  }
  words.append(list);
  return made("div", { className: "detail" }, looks(row), words);
}

function sized(size) {
  return size ? ` (${size[0]} × ${size[1]})` : "";
}

function matrix(transform) {
  const lines = transform.map((numbers) =>
    made("tr", {}, ...numbers.map((number) => made("td", {}, String(Number(number.toPrecision(6)))))),
  );
  return made("table", { className: "matrix" }, made("tbody", {}, ...lines));
}

function looks(row) {
  const element = made("div", { className: "looks" });
  if (!row.thumbnails) {
    element.append(made("p", { className: "faint" }, "There are no thumbnails of this pair."));
    return element;
  }
  const [fixed, before, after] = row.thumbnails;
  const still = made("figure", {}, picture(fixed, "The fixed picture"), made("figcaption", {}, "fixed"));
  const moving = after === null ? framed(before) : slider(row, fixed, before, after);
  element.append(moving, still);
  return element;
}

function framed(before) {
  const caption = made("figcaption", {}, "moving; there is no transform to lay it by");
  return made("figure", {}, picture(before, "The moving picture"), caption);
}

function slider(row, fixed, before, after) {
  const above = picture(after, "The moving picture after alignment");
  const range = made("input", { type: "range", min: 0, max: 100, value: 50 });
  range.setAttribute("aria-label", "Where before ends and after begins, percent of the width");
  const left = made("span", { className: "tag left" }, "before");
  const right = made("span", { className: "tag right" }, "after");
  const handle = made("span", { className: "handle" });
  const below = picture(before, "The moving picture before alignment");
  const compare = made("div", { className: "compare" }, below, above, handle, left, right, range);
  range.addEventListener("input", () => compare.style.setProperty("--at", `${range.value}%`));

  const button = made("button", { type: "button", className: "blink" }, "Blink");
  button.setAttribute("aria-pressed", false);
  const sources = [picture(fixed).src, above.src];
  let timer = null;
  const show = (blinking, turn) => {
    above.classList.toggle("blinking", blinking);
    above.src = sources[turn];
    left.hidden = handle.hidden = range.hidden = blinking;
    right.textContent = ["fixed", "after"][turn];
  };
  const stop = () => {
    clearInterval(timer);
    timer = null;
    show(false, 1);
    button.setAttribute("aria-pressed", false);
  };
  button.addEventListener("click", () => {
    if (timer !== null) return stop();
    let turn = 0;
    button.setAttribute("aria-pressed", true);
    show(true, turn);
    timer = setInterval(() => (button.isConnected ? show(true, (turn = 1 - turn)) : stop()), BLINK_MS);
  });
  const how = "drag, or use the arrow keys; dark is fixed alone";
  const trust = row.status === "aligned" ? how : `as laid by a transform that is ${row.status}`;
  const under = made("div", { className: "under" }, made("figcaption", {}, trust), button);
  return made("figure", {}, compare, under);
}

function draw() {
  const found = chosen();
  const last = Math.max(0, Math.ceil(found.length / PER_PAGE) - 1);
  view.page = Math.min(view.page, last);
  const start = view.page * PER_PAGE;
  const page = found.slice(start, start + PER_PAGE);
  byId("shown").textContent = found.length
    ? `${digits(start + 1)}–${digits(start + page.length)} of ${digits(found.length)}`
    : "none";
  byId("previous").disabled = view.page === 0;
  byId("next").disabled = view.page === last;
  for (const head of heads.filter((each) => each.querySelector("button"))) {
    const order = view.descending ? "descending" : "ascending";
    head.setAttribute("aria-sort", head.dataset.key === view.key ? order : "none");
  }
  for (const button of [byId("all"), ...buttons]) {
    button.setAttribute("aria-pressed", (button.dataset.status ?? "") === view.status);
  }
  byId("rows").replaceChildren(...page.map(line));
  for (const [place, row] of page.entries()) {
    if (view.open.delete(row.order)) toggle(row, byId("rows").querySelectorAll("tr.row")[place]);
  }
  if (!page.length) {
    const told = made("td", { colSpan: heads.length }, "No pair is as asked for.");
    byId("rows").append(made("tr", { className: "none" }, told));
  }
}

function change(changes) {
  Object.assign(view, { page: 0 }, changes);
  draw();
}

function turn(pages) {
  change({ page: view.page + pages });
  document.querySelector("main").scrollIntoView();
}

function show(order) {
  const row = rows[order - 1];
  Object.assign(view, { status: "", words: "", open: new Set([order]) });
  byId("search").value = "";
  change({ page: Math.floor(chosen().indexOf(row) / PER_PAGE) });
  const opened = byId("rows").querySelector("[aria-expanded=true]");
  opened.scrollIntoView({ block: "center" });
  opened.focus({ preventScroll: true });
}

for (const head of heads.filter((each) => each.querySelector("button"))) {
  head.querySelector("button").addEventListener("click", () => {
    const { key, kind } = head.dataset;
    const first = kind === "number" && key !== "order";
    change({ key, descending: view.key === key ? !view.descending : first });
  });
}
for (const button of [byId("all"), ...buttons]) {
  button.addEventListener("click", () => change({ status: button.dataset.status ?? "" }));
}
for (const button of document.querySelectorAll("[data-show]")) {
  button.addEventListener("click", () => show(Number(button.dataset.show)));
}
byId("search").addEventListener("input", () => change({ words: byId("search").value }));
byId("previous").addEventListener("click", () => turn(-1));
byId("next").addEventListener("click", () => turn(1));
byId("reading").remove();
draw();
