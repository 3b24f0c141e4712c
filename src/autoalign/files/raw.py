"""Raw files of cameras and DNG by rawpy (LibRaw), which is installed only on request.

They are developed: white balance as the camera saw it, brightness as it was, colours in sRGB, 16 bits.
"""

from __future__ import annotations

import io
import struct
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from autoalign.files import exif
from autoalign.files.codec import Decoder, Header, Refused
from autoalign.files.metadata import Metadata
from autoalign.picture.pixels import Picture

if TYPE_CHECKING:
    from collections.abc import Iterator

ORIENTATIONS = {3: 3, 5: 8, 6: 6}  # LibRaw's number of a turn to that of EXIF


def decoder() -> Decoder:
    """RGB, uint16; Refused where rawpy is missing."""
    return Decoder(read_header=_read_header, decode=_decode)


def _read_header(data: bytes) -> Header:
    with _opened(data) as raw:
        return Header(
            size=(raw.sizes.iwidth, raw.sizes.iheight),
            orientation=ORIENTATIONS.get(raw.sizes.flip, 1),
            metadata=Metadata(exif=_exif(data)),
        )


def _decode(data: bytes) -> Picture:
    with _opened(data) as raw:
        return np.asarray(raw.postprocess(output_bps=16, use_camera_wb=True, no_auto_bright=True, user_flip=0))


@contextmanager
def _opened(data: bytes) -> Iterator[Any]:
    try:
        import rawpy
    except ImportError:
        raise Refused("is a raw file of a camera; to read it: pip install 'autoalign[raw]'") from None
    with rawpy.imread(io.BytesIO(data)) as raw:
        yield raw


def _exif(data: bytes) -> bytes | None:
    """What the main directory says, for the many raw files that are TIFFs; None for others."""
    try:
        order = exif.byte_order(data[:4])
    except struct.error:
        return None
    (start,) = struct.unpack_from(order + "I", data, 4)
    return exif.block_of(exif.described(exif.read_directory(data, start, exif.Layout(order=order))), order)
