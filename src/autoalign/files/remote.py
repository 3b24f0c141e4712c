"""Files by URL: in buckets of S3, Google Cloud and Azure, and, to be read only, from servers of the web.

Credentials come from the environment, as obstore finds them (AWS_ACCESS_KEY_ID and its like, the roles of machines).
What is secret in a URL, as a signature in its query, goes to its server only: people see what `shown` leaves of it.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any
from urllib.parse import SplitResult, quote, unquote, urlsplit

from autoalign.errors import AutoalignError, ImageReadError, ImageWriteError
from autoalign.files.codec import MAX_REASON
from autoalign.files.read import LoadedPicture, ReadOptions, check_length, decode_picture

if TYPE_CHECKING:
    from obstore.store import ObjectStore

BUCKETS = ("s3", "gs", "az", "abfss")
WEB = ("https", "http")
ANY = (*BUCKETS, *WEB, "file")
SCHEME = re.compile(r"[a-zA-Z][a-zA-Z0-9+.-]+://")  # two letters or more: one is a drive of Windows

CONNECT_S = 10.0
STALLED_S = 30.0  # without a byte
WHOLE_S = 600.0  # for one answer, so that one that drips comes to an end
RETRIES = 3  # of what was busy or broke off
RETRYING_S = 60.0


def is_url(path: str) -> bool:
    """Whether it is no path of this machine."""
    return "://" in path and SCHEME.match(path) is not None


def is_local(url: str) -> bool:
    """Whether a URL is one of a file here, for which `path_of` gives the path."""
    return url[:5].lower() == "file:"


def shown(path: str) -> str:
    """A URL as it may be written down, without user, password, query and fragment; a path as it is."""
    if not is_url(path):
        return path
    scheme, _, rest = path.partition("://")
    host, slash, key = re.split("[?#]", rest, maxsplit=1)[0].partition("/")
    user, at, host = host.rpartition("@")
    # Azure has the container in that place, which is no secret: abfss://container@account.dfs.core.windows.net/key
    container = user.partition(":")[0] + at if scheme.lower() == "abfss" else ""
    return f"{scheme}://{container}{host}{slash}{key}"


def check_url(url: str) -> None:
    """Raise ValueError for a URL that names no file that could be read, ImageReadError without the package for it."""
    if not PurePosixPath(unquote(_checked(url, ANY).path)).name:
        raise ValueError("the URL names no file")
    if not is_local(url):
        with _blaming(ImageReadError, url):
            _package()


def check_upload(url: str) -> None:
    """Raise ValueError for a URL that no file could be put below, ImageWriteError without the package for it."""
    try:
        _checked(url, (*BUCKETS, "file"))
    except ValueError as error:
        raise ValueError(f"{error}: {shown(url)}") from None
    with _blaming(ImageWriteError, url):
        _package()


def below(url: str, name: str) -> str:
    """The URL of a file that is put below another under a name, which may have slashes."""
    return f"{url.rstrip('/')}/{quote(name.encode('utf-8', 'surrogateescape'))}"


def path_of(url: str) -> Path:
    """A path that names a file as its URL does, from the root on; of file:// the file itself, of others nothing."""
    scheme, _, rest = shown(url).partition("://")
    if is_local(url):
        return Path("/", unquote(rest.partition("/")[2]))
    return Path("/", scheme.lower(), unquote(rest).lstrip("/"))


def read_url(url: str, options: ReadOptions = ReadOptions(), *, page: int = 0) -> LoadedPicture:
    """As `read_picture`, of a URL, whose bytes nothing but memory ever holds; no more of them than it allows."""
    return decode_picture(_fetched(url, options), path_of(url), shown(url), options, page=page)


def version_of(url: str) -> str | None:
    """What changes with the content behind a URL, as its server tells without sending it; None if it does not."""
    try:
        with _blaming(ImageReadError, url):
            store, key = _place(url)
            found = store.head(key)
    except ImageReadError:  # some know no HEAD, and a signature may be for GET alone; or there is nothing, as GET says
        return None
    # Some servers have times only, which are those of a second and are kept by what copies files: not enough to go by.
    return found["e_tag"] and f"{found['e_tag']} {found['size']} {found['last_modified'].isoformat()}"


def hash_of(url: str) -> str:
    """SHA-256, in hexadecimal, of its version, or of the content where the server tells none.

    Raises ImageReadError, the URL last.
    """
    version = version_of(url)
    return hashlib.sha256(_fetched(url, ReadOptions()) if version is None else version.encode()).hexdigest()


def upload(path: Path, url: str, name: str) -> None:
    """Put a file below a URL under a name; what has that name there is replaced, and never seen in part.

    Raises ImageWriteError, the file's URL last.
    """
    with _blaming(ImageWriteError, below(url, name)):
        store, key = _place(url)
        store.put(f"{key}/{name}".lstrip("/"), path)


def _checked(url: str, schemes: tuple[str, ...]) -> SplitResult:
    """The parts of a URL with one of these schemes. Raises ValueError, which names nothing secret."""
    try:
        parts = urlsplit(url)
    except ValueError:  # whose message may hold the password
        raise ValueError("is no URL") from None
    if parts.scheme not in schemes:
        raise ValueError(f"the URL begins with {', '.join(schemes[:-1])} or {schemes[-1]}, not {parts.scheme}")
    if not parts.netloc and parts.scheme != "file":
        raise ValueError(f"the URL names no {'host' if parts.scheme in WEB else 'bucket'}")
    if parts.scheme == "file" and parts.netloc not in ("", "localhost"):
        raise ValueError("the URL of a file names another host")
    if parts.password is not None or (parts.username is not None and parts.scheme != "abfss"):
        raise ValueError("credentials are taken from the environment, never from a URL")
    if parts.fragment or (parts.query and parts.scheme not in WEB):
        raise ValueError("the URL has a # or ?, which the name of a file has as %23 or %3F")
    return parts


def _fetched(url: str, options: ReadOptions) -> bytes:
    """All bytes behind a URL; ImageReadError, the URL last, for more than a picture may have, and for all else."""
    with _blaming(ImageReadError, url):
        store, key = _place(url)
        answer = store.get(key)
        check_length(answer.meta["size"], options, shown(url))
        return bytes(answer.bytes())


def _place(url: str) -> tuple[ObjectStore, str]:
    """The store that a URL is in, and its name there. Raises ValueError, and what obstore raises."""
    parts = _checked(url, ANY)
    if is_local(url):
        return _package().LocalStore(path_of(url), mkdir=True), ""
    if parts.scheme in WEB:
        # The whole URL is the store: so it is asked for as it was written, with its query and whatever was escaped.
        # Redirects are followed to http and https only, and without allow_http not to http.
        return _package().from_url(url, **_terms(allow_http=parts.scheme == "http")), ""
    return _bucket(f"{parts.scheme}://{parts.netloc}"), unquote(parts.path).strip("/")


@lru_cache
def _bucket(url: str) -> ObjectStore:
    """Kept, with its connections and with the credentials that it may have had to ask for."""
    # Of the environment, obstore forgets this one thing once it is told how long to wait; stores at home need it.
    allow_http = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true", "yes")
    store: ObjectStore = _package().from_url(url, **_terms(allow_http=allow_http))
    return store


def _terms(*, allow_http: bool) -> dict[str, Any]:
    """How long a server is waited for, and how often it is asked again."""
    patience = {"connect_timeout": CONNECT_S, "read_timeout": STALLED_S, "timeout": WHOLE_S}
    return {
        "client_options": {"allow_http": allow_http}
        | {name: timedelta(seconds=seconds) for name, seconds in patience.items()},
        "retry_config": {"max_retries": RETRIES, "retry_timeout": timedelta(seconds=RETRYING_S)},
    }


def _package() -> Any:
    """The module obstore.store, which is installed only on request."""
    try:
        import obstore.store
    except ImportError:
        raise _MissingPackage from None
    return obstore.store


class _MissingPackage(Exception):  # noqa: N818 - turned into an error before anybody sees it
    pass


@contextmanager
def _blaming(kind: type[AutoalignError], url: str) -> Iterator[None]:
    """Whatever is raised as an error that names this URL, without what is secret in it."""
    try:
        yield
    except AutoalignError:
        raise
    except Exception as error:  # obstore raises what it likes, and prints signatures: nothing of it is chained
        what = "cannot be read" if kind is ImageReadError else "cannot be uploaded"
        raise kind(f"{what} ({_reason(error)}): {shown(url)}") from None


def _reason(error: Exception) -> str:
    """Why a request failed. What obstore says holds the URL with its query, and what the server has sent."""
    text = str(error)
    if isinstance(error, _MissingPackage):
        return "URLs need: pip install 'autoalign[remote]'"
    if isinstance(error, FileNotFoundError):
        return "does not exist"
    if "169.254.169.254" in text or "metadata.google" in text:  # where machines of a cloud ask for their credentials
        return "the environment has no credentials for it"
    if type(error).__name__ in ("PermissionDeniedError", "UnauthenticatedError"):
        return "permission denied"
    if "kind: Timeout" in text:
        return "the server does not answer in time"
    if "Content-Length" in text:
        return "the server does not say how long it is"
    if status := re.search(r"status code: ([0-9]{3}[A-Za-z ]*)", text):
        return f"the server says {status[1].strip()}"
    if said := re.search(r'message: "([^"]*)"', text):  # by the operating system, such as: Connection refused
        return said[1]
    return re.sub(r"\S+://\S+", "...", text.partition("\n")[0]).rpartition(" - ")[2][:MAX_REASON]
