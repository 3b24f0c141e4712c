"""What microscopes and ImageJ write into the description of a TIFF: the size of a pixel in the specimen, above all.

Two dialects are known: OME-XML, and the lines of ImageJ, which also give the resolution tags a unit of their own.
"""

from __future__ import annotations

import re
from xml.dom import minidom
from xml.parsers.expat import ExpatError

MICRONS_PER_INCH = 25_400.0
MICRONS = {"nm": 1e-3, "µm": 1.0, "um": 1.0, "micron": 1.0, "microns": 1.0, "\\u00B5m": 1.0}
MICRONS |= {"mm": 1e3, "cm": 1e4, "m": 1e6, "inch": MICRONS_PER_INCH, "in": MICRONS_PER_INCH, "pm": 1e-6, "Å": 1e-4}
STACK_LINES = r"(?:images|channels|slices|frames|hyperstack|mode|loop|spacing|finterval|fps|tunit)=.*\n?"
"""Lines of ImageJ that speak of more than one picture."""

Dpi = tuple[float, float]


def is_known(description: str) -> bool:
    """True for a description in one of the two dialects."""
    return _is_imagej(description) or _is_ome(description)


def of_plane(description: str, number: int) -> str | None:
    """The description of a whole file made that of its picture `number`, from 0; None if it makes no sense."""
    if _is_imagej(description):
        return re.sub(STACK_LINES, "", description)
    pixels = _pixels(_document(description))
    if pixels is None:
        return None
    _keep_channel(pixels, _channel_index(pixels, number))
    for name in ("TiffData", "Plane"):
        for element in _children(pixels, name):
            pixels.removeChild(element)
    for name in ("SizeZ", "SizeT"):
        pixels.setAttribute(name, "1")
    data = minidom.Element(pixels.tagName.replace("Pixels", "TiffData"), pixels.namespaceURI)
    data.ownerDocument = pixels.ownerDocument
    data.setAttribute("IFD", "0")
    data.setAttribute("PlaneCount", "1")
    # The schema wants it behind the channels and before what is said about the planes.
    behind = [node for node in pixels.childNodes if isinstance(node, minidom.Element) and node.localName != "Channel"]
    pixels.insertBefore(data, behind[0] if behind else None)
    return _text(pixels)


def dpi_of(description: str, tags_dpi: Dpi | None, ratio: Dpi | None) -> Dpi | None:
    """Pixels per inch along x and y; `tags_dpi` where the description says nothing.

    `ratio` is what the resolution tags of the file say, without their unit: ImageJ puts the unit into its lines.
    """
    if _is_imagej(description):
        unit = _imagej_microns(description)
        return (ratio[0] / unit * MICRONS_PER_INCH, ratio[1] / unit * MICRONS_PER_INCH) if unit and ratio else tags_dpi
    pixels = _pixels(_document(description))
    x, y = (_ome_microns(pixels, axis) if pixels else None for axis in "XY")
    return (MICRONS_PER_INCH / x, MICRONS_PER_INCH / y) if x and y else tags_dpi


def with_grid(description: str, size: tuple[int, int], dpi: Dpi | None) -> str:
    """The description of one picture made true for `size` (w, h) and this resolution; None: it is not known."""
    pixels = None if _is_imagej(description) else _pixels(_document(description))
    if pixels is None:
        return description
    for axis, side, dots in zip("XY", size, dpi or (None, None), strict=True):
        pixels.setAttribute(f"Size{axis}", str(side))
        for name in (f"PhysicalSize{axis}", f"PhysicalSize{axis}Unit"):
            if pixels.hasAttribute(name):
                pixels.removeAttribute(name)
        if dots:
            pixels.setAttribute(f"PhysicalSize{axis}", f"{MICRONS_PER_INCH / dots:.12g}")
            pixels.setAttribute(f"PhysicalSize{axis}Unit", "µm")
    return _text(pixels)


def tag_resolution(description: str, dpi: Dpi) -> Dpi | None:
    """What the resolution tags beside the lines of ImageJ must say, pixels per its own unit; None in other cases."""
    unit = _imagej_microns(description) if _is_imagej(description) else None
    return (dpi[0] * unit / MICRONS_PER_INCH, dpi[1] * unit / MICRONS_PER_INCH) if unit else None


def _is_imagej(description: str) -> bool:
    return description.startswith("ImageJ=")


def _is_ome(description: str) -> bool:
    return description.rstrip("\0 \r\n").endswith("OME>")


def _imagej_microns(description: str) -> float | None:
    unit = re.search(r"^unit=(.*)$", description, re.MULTILINE)
    return MICRONS.get(unit[1].strip()) if unit else None


def _document(description: str) -> minidom.Document | None:
    if "<!DOCTYPE" in description or "<!ENTITY" in description:  # no OME file has one, and it may be a bomb
        return None
    try:
        return minidom.parseString(description.rstrip("\0 \r\n").encode())
    except (ExpatError, ValueError):
        return None


def _pixels(document: minidom.Document | None) -> minidom.Element | None:
    """What describes the pixels of the first picture."""
    found = document.getElementsByTagNameNS("*", "Pixels") if document else []
    return found[0] if found else None


def _children(parent: minidom.Element, name: str) -> list[minidom.Element]:
    return [node for node in parent.childNodes if isinstance(node, minidom.Element) and node.localName == name]


def _text(element: minidom.Element) -> str:
    """The document that this is a part of, as XML."""
    while isinstance(element.parentNode, minidom.Element):
        element = element.parentNode
    return element.toxml()


def _channel_index(pixels: minidom.Element, number: int) -> int:
    """The channel of the plane `number`: planes count along the axes after x and y, in the order that is said."""
    stride = 1
    for axis in pixels.getAttribute("DimensionOrder")[2:]:
        count = _whole(pixels, f"Size{axis}")
        if axis == "C":
            count = max(len(_children(pixels, "Channel")), 1)
            return number // stride % count
        stride *= count
    return 0


def _keep_channel(pixels: minidom.Element, index: int) -> None:
    samples = "1"
    for i, channel in enumerate(_children(pixels, "Channel")):
        if i == index:
            samples = channel.getAttribute("SamplesPerPixel") or "1"
        else:
            pixels.removeChild(channel)
    pixels.setAttribute("SizeC", samples)


def _whole(element: minidom.Element, name: str) -> int:
    text = element.getAttribute(name)
    return max(int(text), 1) if text.isdecimal() and len(text) < 10 else 1


def _ome_microns(pixels: minidom.Element, axis: str) -> float | None:
    unit = MICRONS.get(pixels.getAttribute(f"PhysicalSize{axis}Unit") or "µm")
    try:
        size = float(pixels.getAttribute(f"PhysicalSize{axis}"))
    except ValueError:
        return None
    return size * unit if unit and 0 < size < 1e12 else None
