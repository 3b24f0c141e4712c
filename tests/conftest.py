"""A server on this machine that stands for the web and for a bucket, with the manners that servers have."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from autoalign.files import remote

SECRET = "wJalrXUtnFEMI"  # in signatures and keys; nobody but the server may see it


class Server(ThreadingHTTPServer):
    """Files by path, what is wrong with some of them, and what was asked for."""

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), Handler)
        self.files: dict[str, bytes] = {}
        self.answers: dict[str, int] = {}  # status in place of the file
        self.manners: dict[str, str] = {}  # slow, stalling, chunked, huge, untagged, headless, or where it is instead
        self.asked: list[tuple[str, str]] = []  # method and path with its query
        self.released = threading.Event()  # ends what is slow

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def handle_error(self, *_: object) -> None:
        """Whoever asks may go away in the middle: that is what is tested."""


class Handler(BaseHTTPRequestHandler):
    """What the server answers; buckets are the first folders."""

    protocol_version = "HTTP/1.1"
    server: Server

    def log_message(self, *_: object) -> None:
        """Not on stderr."""

    def do_GET(self) -> None:
        path = self._path()
        manner, data = self.server.manners.get(path, ""), self.server.files.get(path, b"")
        status = self.server.answers.get(path, 200 if path in self.server.files else 404)
        if manner == "headless" and self.command == "HEAD":
            status = 403
        if manner == "slow":
            self.server.released.wait(5)
        if "://" in manner or manner.startswith("/"):
            self._answer(302, b"", Location=manner)
        elif manner == "chunked":
            self._answer(200, b"1\r\nx\r\n0\r\n\r\n", **{"Transfer-Encoding": "chunked"})
        elif manner == "stalling":
            self._answer(200, data[:-1], **{"Content-Length": str(len(data))})
            self.server.released.wait(5)
        elif manner == "huge":
            self._answer(200, b"x", **{"Content-Length": str(1 << 40)})
            self.close_connection = True
        elif status != 200:
            self._answer(status, f"<Error>{SECRET}</Error>".encode())
        else:
            tag = {} if manner == "untagged" else {"ETag": f'"{hashlib.md5(data).hexdigest()}"'}
            self._answer(200, data, **tag)

    do_HEAD = do_GET  # noqa: N815

    def do_PUT(self) -> None:
        path, data = self._path(), self.rfile.read(int(self.headers["Content-Length"]))
        status = self.server.answers.get(path, 200)
        if status == 200:
            self.server.files[path] = data
        self._answer(status, b"", ETag=f'"{hashlib.md5(data).hexdigest()}"')

    def _path(self) -> str:
        self.server.asked.append((self.command, self.path))
        return self.path.partition("?")[0]

    def _answer(self, status: int, body: bytes, **headers: str) -> None:
        self.send_response(status)
        if "Transfer-Encoding" not in headers:
            headers.setdefault("Content-Length", str(len(body)))
        for name, value in {"Last-Modified": "Wed, 21 Oct 2015 07:28:00 GMT", **headers}.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    """The server, which is also where s3:// leads; whoever asks has little patience."""
    with Server() as found:
        thread = threading.Thread(target=found.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        for name, value in {
            "AWS_ENDPOINT_URL": found.url,
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "eu-central-1",
            "AWS_ACCESS_KEY_ID": "AKIAIOSFODNN7EXAMPLE",
            "AWS_SECRET_ACCESS_KEY": SECRET,
        }.items():
            monkeypatch.setenv(name, value)
        for name, limit in {"STALLED_S": 0.4, "RETRIES": 0}.items():
            monkeypatch.setattr(remote, name, limit)
        remote._bucket.cache_clear()
        yield found
        remote._bucket.cache_clear()
        found.released.set()
        found.shutdown()
        thread.join()
