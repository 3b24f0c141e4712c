"""The pictures that a worker keeps: read and prepared once while they fit, since a batch meets many of them again."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from autoalign.files.large import is_large
from autoalign.files.read import state_of
from autoalign.files.ready import Ready, Source, opened_source
from autoalign.files.remote import is_url, version_of

MAX_BYTES = 512 * 2**20


class PictureMemory:
    """The pictures used last, within a bound; a file that was changed is read again.

    Of one that stays in its file the copy is kept, and the file opened anew.
    """

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._kept: OrderedDict[tuple[object, ...], Ready] = OrderedDict()

    @contextmanager
    def opened(self, source: Source) -> Iterator[Ready]:
        """The picture, open to be read as long as the block lasts. Raises ImageReadError."""
        stamp = (source, _stamp(source.path), source.mask and _stamp(source.mask))
        with _opened(source, self._kept.get(stamp)) as ready:
            self._kept[stamp] = ready
            try:
                yield ready
            finally:
                self._kept[stamp] = ready
                self._kept.move_to_end(stamp)  # the one let go last, which of a pair is the fixed one, stays longest
                self._shrink()

    def _shrink(self) -> None:
        """Forget what was not used for longest; the last one stays, whatever its size."""
        total = sum(ready.nbytes for ready in self._kept.values())
        while total > self._max_bytes and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            total -= oldest.nbytes


@contextmanager
def _opened(source: Source, kept: Ready | None) -> Iterator[Ready]:
    if kept is not None and not is_large(kept.picture):
        yield kept
        return
    with opened_source(source) as ready:
        known = kept is not None and kept.picture.sha256 == ready.picture.sha256
        yield replace(kept, picture=ready.picture) if kept is not None and known else ready


def _stamp(path: str) -> object:
    """What changes with a file's content; None for a file that is not there, which reading it will say."""
    if is_url(path):
        return version_of(path) or object()  # which equals no other: what cannot be told apart is fetched again
    try:
        return state_of(path)
    except (OSError, ValueError):
        return None
