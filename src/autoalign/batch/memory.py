"""The pictures that a worker keeps: read and prepared once while they fit, since a batch meets many of them again."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from pathlib import Path

from autoalign.files.feature_store import recall_from
from autoalign.files.read import LoadedPicture, ReadOptions, read_picture, state_of
from autoalign.files.remote import is_url, read_url, shown, version_of
from autoalign.files.sized import as_mask
from autoalign.picture.pixels import size_of
from autoalign.registration.prepared import Prepared, prepare

MAX_BYTES = 512 * 2**20


@dataclass(frozen=True, kw_only=True)
class Ready:
    """A picture as its file has it, and as it is aligned."""

    loaded: LoadedPicture
    prepared: Prepared

    @property
    def nbytes(self) -> int:
        return self.loaded.pixels.nbytes + self.prepared.nbytes


@dataclass(frozen=True, kw_only=True)
class Source:
    """Where a picture is, and what of it is taken."""

    path: str  # or a URL
    mask: str | None = None  # a picture of the same size that is not black where this one is to be ignored
    page: int = 0
    reading: ReadOptions = ReadOptions()


class PictureMemory:
    """The pictures used last, within a bound; a file that was changed is read again."""

    def __init__(self, max_bytes: int = MAX_BYTES) -> None:
        self._max_bytes = max_bytes
        self._kept: OrderedDict[tuple[object, ...], Ready] = OrderedDict()

    def ready(self, source: Source, store: str | None = None) -> Ready:
        """The picture, its features kept in the folder `store` if one is given. Raises ImageReadError."""
        stamp = (source, _stamp(source.path), source.mask and _stamp(source.mask), store)
        found = self._kept.pop(stamp, None) or _read(source, store)
        self._kept[stamp] = found
        self._shrink()
        return found

    def _shrink(self) -> None:
        """Forget what was not used for longest; the last one stays, whatever its size."""
        total = sum(ready.nbytes for ready in self._kept.values())
        while total > self._max_bytes and len(self._kept) > 1:
            _, oldest = self._kept.popitem(last=False)
            total -= oldest.nbytes


def _read(source: Source, store: str | None) -> Ready:
    loaded = _loaded(source.path, source.reading, source.page)
    hidden = as_mask(_loaded(source.mask), size_of(loaded.pixels), shown(source.mask)) if source.mask else None
    identity = f"{loaded.sha256} {source.page} {source.reading.lenient} {hidden.sha256 if hidden else ''}"
    valid = hidden.valid if hidden else None
    recall = recall_from(Path(store), identity) if store else None
    return Ready(loaded=loaded, prepared=prepare(loaded.pixels, valid, recall=recall))


def _loaded(path: str, reading: ReadOptions = ReadOptions(), page: int = 0) -> LoadedPicture:
    return (read_url if is_url(path) else read_picture)(path, reading, page=page)


def _stamp(path: str) -> object:
    """What changes with a file's content; None for a file that is not there, which reading it will say."""
    if is_url(path):
        return version_of(path) or object()  # which equals no other: what cannot be told apart is fetched again
    try:
        return state_of(path)
    except (OSError, ValueError):
        return None
