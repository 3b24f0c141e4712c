"""Pictures as a viewer can hold them: a file's own bytes where they will do, else encoded, and both in one frame."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from autoalign.files.formats import HEAD_BYTES, JPEG, PNG, Format, decoder_for, encoder_for, of_bytes
from autoalign.files.metadata import Metadata
from autoalign.files.read import LoadedPicture
from autoalign.files.row import Thumbnails
from autoalign.geometry.homography import Array, jacobian, scaling, translation
from autoalign.geometry.uncertainty import overlap_points
from autoalign.picture.compose import compose
from autoalign.picture.pixels import Picture, has_alpha, in_colour, opaque, shrink, size_of, to_8_bit
from autoalign.picture.warp import warp

MAX_SIDE = 8192  # px; the textures of many a graphics card and of every browser end here
LAYER_PIXELS = 1e6  # of the pictures of both in one frame, which share a screen with others; some 200 kB each
QUALITY = 80  # of JPEGs made here: no artefact that could be taken for a misalignment
THUMBNAIL_SIDE = 160  # px, of the longer one
THUMBNAIL_QUALITY = 70  # of JPEGs that stand by the thousand in one file
_TINT = np.array([70, 150, 255], np.uint16)  # of the moving picture's squares of the checkerboard
_TINTED = 56  # 256ths

_MEDIA_TYPES: dict[Format, str] = {JPEG: "image/jpeg", PNG: "image/png"}  # all that the viewer decodes

_Pixels = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Encoded:
    """The bytes of a picture that a viewer can decode."""

    data: bytes
    media_type: str
    size: tuple[int, int]  # (w, h) of the picture in the bytes


@dataclass(frozen=True, kw_only=True)
class Shown:
    """One picture for a viewer, and what a person must know about how it is shown."""

    picture: Encoded
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Layers:
    """Both pictures in the frame of the fixed one, which is shrunken where it is large."""

    size: tuple[int, int]  # (w, h) of all of them
    fixed: Encoded | None  # None where the picture itself, as it is shown, serves
    moving: Encoded  # and the fixed one where the moving one has no data, so that blending changes the overlap alone
    checkerboard: Encoded  # the moving one's squares are tinted
    green_magenta: Encoded  # fixed in green, moving in magenta, grey where they agree; fixed alone is dark
    difference: Encoded


@dataclass(frozen=True, kw_only=True)
class _Both:
    """Two pictures in one frame."""

    fixed: _Pixels  # (h, w, 3)
    moving: _Pixels  # (h, w, 3), black where it has no data
    valid: NDArray[np.bool_]  # (h, w) where the moving one has data

    def in_context(self, drawn: _Pixels) -> _Pixels:
        """What is drawn where the moving one has data; elsewhere the fixed one, dark."""
        return np.where(self.valid[..., None], drawn, self.fixed // 3)


def original_bytes(loaded: LoadedPicture) -> bytes | None:
    """The file's bytes, if a viewer may decode them, and they still are those that were read."""
    if loaded.remark or loaded.format not in {format.name for format in _MEDIA_TYPES}:
        return None
    try:
        data = loaded.path.read_bytes()
    except OSError:
        return None
    return data if hashlib.sha256(data).hexdigest() == loaded.sha256 else None


def as_shown(picture: Picture, name: str, original: bytes | None = None) -> Shown:
    """A picture at its full size, if the viewer can hold that. `original` are the bytes of the file it was read from,
    which are taken as they are where a viewer makes the same picture of them."""
    kept = None if original is None else _kept(picture, original)
    if kept is not None:
        return Shown(picture=kept)
    w, h = size_of(picture)
    smaller = shrink(picture, min(1.0, MAX_SIDE / max(w, h)) ** 2 * w * h).pixels
    notes = []
    if size_of(smaller) != (w, h):
        notes.append(f"{name} is shown at {smaller.shape[1]} × {smaller.shape[0]}, its full size is {w} × {h}")
    if picture.dtype != np.uint8:
        notes.append(f"{name} has {picture.dtype} pixels, whose range is stretched to what a screen shows")
    colours = smaller[..., :-1] if has_alpha(smaller) else smaller
    return Shown(picture=_encoded(to_8_bit(colours)), notes=tuple(notes))


def layers(fixed: Picture, moving: Picture, fixed_from_moving: Array) -> Layers | None:
    """Both pictures in one frame under a transform (3, 3), whatever the verdict on it; None if it has no inverse."""
    both = _in_one_frame(fixed, moving, fixed_from_moving)
    if both is None:
        return None
    a, b, valid = both.fixed, both.moving, both.valid

    def drawn(style: str, moving_pixels: _Pixels = b) -> _Pixels:
        return compose(style, a, moving_pixels, None, valid)

    return Layers(
        size=size_of(a),
        fixed=None if size_of(a) == size_of(fixed) and fixed.dtype == np.uint8 else _encoded(a),
        moving=_encoded(np.where(valid[..., None], b, a)),
        checkerboard=_encoded(drawn("checkerboard", _tinted(b))),
        green_magenta=_encoded(both.in_context(drawn("red-cyan")[..., [1, 0, 1]])),
        difference=_encoded(drawn("difference")),
    )


def thumbnails(fixed: Picture, moving: Picture, fixed_from_moving: Array | None) -> Thumbnails:
    """Both pictures small, and the moving one as a transform (3, 3) lays it, whatever the verdict on that.

    Before, the moving picture stands whole in the middle of the fixed one's frame, its sides in proportion; after,
    where it has no data, the fixed one shows dark, so that one sees how it goes on. The same fixed picture gives the
    same bytes beside any other. Without a transform, or with one that has no inverse, `after` is None. Pictures are
    (h, w) or (h, w, 1..4), of any depth that autoalign reads.
    """
    w, h = size_of(fixed)
    small = shrink(fixed, min(1.0, THUMBNAIL_SIDE / max(w, h)) ** 2 * w * h)
    small_from_fixed = np.linalg.inv(small.full_from_small)
    before = _in_one_frame(small.pixels, moving, _fitted(size_of(moving), size_of(small.pixels)))
    assert before is not None  # a fit has an inverse
    after = None
    if fixed_from_moving is not None:
        after = _in_one_frame(small.pixels, moving, small_from_fixed @ fixed_from_moving)
    return Thumbnails(
        fixed=_encoded(before.fixed, THUMBNAIL_QUALITY).data,
        before=_encoded(before.moving, THUMBNAIL_QUALITY).data,
        after=None if after is None else _encoded(after.in_context(after.moving), THUMBNAIL_QUALITY).data,
    )


def _fitted(moving_size: tuple[int, int], fixed_size: tuple[int, int]) -> Array:
    """(3, 3) fixed_from_moving that fits the moving picture into the fixed one's frame, middle on middle."""
    scale = min(fixed_size[0] / moving_size[0], fixed_size[1] / moving_size[1])
    (x, y), (moving_x, moving_y) = (((w - 1) / 2, (h - 1) / 2) for w, h in (fixed_size, moving_size))
    return translation(x, y) @ scaling(scale, scale) @ translation(-moving_x, -moving_y)


def _in_one_frame(fixed: Picture, moving: Picture, fixed_from_moving: Array) -> _Both | None:
    """Both in the frame of the fixed one, which is shrunken to `LAYER_PIXELS`; None if the transform has no inverse."""
    if np.linalg.matrix_rank(fixed_from_moving) < 3:
        return None
    still = shrink(fixed, LAYER_PIXELS)
    mover = shrink(moving, moving.shape[0] * moving.shape[1] / _squeeze(fixed, moving, fixed_from_moving) ** 2)
    small_from_fixed = np.linalg.inv(still.full_from_small)
    moved = warp(mover.pixels, size_of(still.pixels), small_from_fixed @ fixed_from_moving @ mover.full_from_small)
    # Side by side they become alike: 8-bit and free of alpha.
    both = in_colour(compose("side-by-side", still.pixels, moved.pixels, None, moved.valid))
    a, b = both[:, : both.shape[1] // 2], both[:, both.shape[1] // 2 :]
    seen = opaque(moved.pixels)
    return _Both(fixed=a, moving=b, valid=moved.valid if seen is None else moved.valid & seen)


def _kept(picture: Picture, original: bytes) -> Encoded | None:
    """The original bytes if a viewer that knows neither orientations nor 16 bits makes this picture of them."""
    format = of_bytes(original[:HEAD_BYTES])
    if format not in _MEDIA_TYPES or picture.dtype != np.uint8 or max(size_of(picture)) > MAX_SIDE:
        return None
    header = decoder_for(format, 0).read_header(original)
    if header.orientation != 1 or header.size != size_of(picture):
        return None
    return Encoded(data=original, media_type=_MEDIA_TYPES[format], size=header.size)


def _encoded(pixels: _Pixels, quality: int = QUALITY) -> Encoded:
    grey = pixels[..., 0] if pixels.shape[2:] == (1,) else pixels
    data = encoder_for(JPEG, quality)(grey, Metadata())
    return Encoded(data=data, media_type=_MEDIA_TYPES[JPEG], size=size_of(pixels))


def _squeeze(fixed: Picture, moving: Picture, fixed_from_moving: Array) -> float:
    """How many times the moving picture is shrunken on its way into the layers' frame, 1 to 64.

    What bilinear sampling would skip must be averaged before, or fine detail would look like disagreement.
    """
    w, h = size_of(fixed)
    inside = overlap_points(fixed_from_moving, size_of(moving), (w, h))
    if not len(inside):
        return 1.0
    zoom = float(np.median(np.sqrt(np.abs(np.linalg.det(jacobian(fixed_from_moving, inside))))))
    return float(np.clip(max(1.0, (w * h / LAYER_PIXELS) ** 0.5) / max(zoom, 1e-6), 1.0, 64.0))


def _tinted(pixels: _Pixels) -> _Pixels:
    mixed = pixels * np.uint16(256 - _TINTED) + _TINT * np.uint16(_TINTED)  # at most 255 x 256
    return np.asarray(mixed >> 8, np.uint8)
