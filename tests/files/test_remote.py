"""Files by URL: the bytes that were meant, within limits, and nothing secret in what people read."""

from __future__ import annotations

import hashlib
import re
import socket
import sys
from pathlib import Path

import numpy as np
import pytest

import autoalign as aa
from autoalign.errors import ImageReadError, ImageWriteError
from autoalign.files.read import ReadOptions
from autoalign.files.remote import (
    below,
    check_upload,
    check_url,
    hash_of,
    is_url,
    path_of,
    read_url,
    shown,
    upload,
    version_of,
)

SECRET = "wJalrXUtnFEMI"  # as in conftest.py


@pytest.fixture
def png(make_picture, tmp_path) -> bytes:
    aa.write_picture(tmp_path / "a.png", make_picture())
    return (tmp_path / "a.png").read_bytes()


@pytest.mark.parametrize(
    ("path", "url"),
    [("s3://b/k", True), ("HTTPS://h/x", True), ("gs://", True)]
    + [(path, False) for path in ("a/b.png", "C://x.png", "a://b", "/x/s3://b", "://", "s3:/b/k", "é3://x")],
)
def test_what_is_a_url(path, url):
    assert is_url(path) == url


@pytest.mark.parametrize(
    ("url", "visible"),
    [
        ("https://h:8000/a/b%20c.png?X-Amz-Signature=s#f", "https://h:8000/a/b%20c.png"),
        ("https://me:word@h/a.png", "https://h/a.png"),
        ("https://me:w@rd?/@h/a.png", "https://rd"),
        ("https://h?q=me@x/y", "https://h"),
        ("abfss://container@account.dfs.core.windows.net/k", "abfss://container@account.dfs.core.windows.net/k"),
        ("abfss://container:word@account/k?sig=s", "abfss://container@account/k"),
        ("http://[", "http://["),
        ("a/b?c#d@e.png", "a/b?c#d@e.png"),
    ],
)
def test_what_of_a_url_is_written_down(url, visible):
    assert shown(url) == visible


def test_the_paths_that_urls_stand_for():
    assert path_of("s3://bucket/day%201/a.jpg") == Path("/s3/bucket/day 1/a.jpg")
    assert path_of("HTTPS://h:80//x.png?name=y.jpg") == Path("/https/h:80/x.png")
    assert path_of("file:///data/a%20b.png") == path_of("file://localhost/data/a%20b.png") == Path("/data/a b.png")
    assert below("s3://bucket/out/", "day 1/ü#?.png") == "s3://bucket/out/day%201/%C3%BC%23%3F.png"
    assert path_of(below("s3://bucket", "day 1/ü#?.png")) == Path("/s3/bucket/day 1/ü#?.png")
    assert below("s3://bucket", "\udcff.png") == "s3://bucket/%FF.png"


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("ftp://h/a.png", "begins with s3, gs, az, abfss, https, http or file, not ftp"),
        ("s3:///a.png", "names no bucket"),
        ("https:///a.png", "names no host"),
        ("https://h/", "names no file"),
        ("s3://bucket", "names no file"),
        ("file://elsewhere/a.png", "names another host"),
        (f"https://me:{SECRET}@h/a.png", "credentials are taken from the environment"),
        (f"https://{SECRET}@h/a.png", "credentials are taken from the environment"),
        (f"abfss://c:{SECRET}@h/a.png", "credentials are taken from the environment"),
        (f"https://me:{SECRET}@[/a.png", "is no URL"),
        ("s3://b/a#1.png", "has as %23 or %3F"),
        ("s3://b/a.png?versionId=1", "has as %23 or %3F"),
        ("https://h/a.png#top", "has as %23 or %3F"),
    ],
)
def test_what_cannot_be_fetched(url, message):
    with pytest.raises(ValueError, match=message) as caught:
        check_url(url)
    assert SECRET not in str(caught.value)


@pytest.mark.parametrize("url", ["https://h/x", "http://h", "nowhere", f"s3://k:{SECRET}@b", f"az://c/x?sig={SECRET}"])
def test_what_nothing_can_be_put_below(url):
    with pytest.raises(ValueError, match=re.escape(f": {shown(url)}") + "$") as caught:
        check_upload(url)
    assert SECRET not in str(caught.value)


def test_what_can_be_used():
    for url in ("s3://b/k", "gs://b/a b", "az://c/k", "abfss://c@a.dfs.core.windows.net/k", "file:///a"):
        check_url(url)
        check_upload(url)
    check_url("https://h/x?signature=y")


def test_a_picture_from_the_web_is_the_one_of_the_file(server, png, tmp_path):
    server.files["/day%201/a.png"] = png
    here, there = aa.read_picture(tmp_path / "a.png"), read_url(f"{server.url}/day%201/a.png?sig={SECRET}%2F+&x")
    assert np.array_equal(there.pixels, here.pixels)
    assert (there.sha256, there.format, there.path.name) == (here.sha256, "PNG", "a.png")
    assert server.asked == [("GET", f"/day%201/a.png?sig={SECRET}%2F+&x")]  # as it was written


def test_a_picture_from_a_bucket(server, png):
    server.files["/bucket/day%201/a%2Bb.png"] = png
    assert read_url("s3://bucket/day%201/a+b.png").sha256 == hashlib.sha256(png).hexdigest()


@pytest.mark.parametrize(
    ("manner", "status", "reason"),
    [
        ("", 404, "cannot be read (does not exist)"),
        ("", 403, "cannot be read (permission denied)"),
        ("", 401, "cannot be read (permission denied)"),
        ("", 503, "cannot be read (the server says 503 Service Unavailable)"),
        ("slow", 200, "cannot be read (the server does not answer in time)"),
        ("stalling", 200, "cannot be read (the server does not answer in time)"),
        ("chunked", 200, "cannot be read (the server does not say how long it is)"),
        ("huge", 200, "is larger than the 4.9 GB that a picture as large as allowed takes"),
        ("file:///etc/hostname", 200, "cannot be read (the server says 302 Found)"),
        ("ftp://127.0.0.1/a.png", 200, "cannot be read (HTTP error: builder error)"),
        ("/a.png", 200, "cannot be read (HTTP error: error following redirect)"),
    ],
)
def test_what_goes_wrong_on_the_way_is_one_line_without_secrets(server, png, manner, status, reason):
    server.files["/a.png"], server.manners["/a.png"], server.answers["/a.png"] = png, manner, status
    with pytest.raises(ImageReadError) as caught:
        read_url(f"{server.url}/a.png?sig={SECRET}")
    assert str(caught.value) == f"{reason}: {server.url}/a.png"
    assert caught.value.__cause__ is None
    assert caught.value.__context__ is None or caught.value.__suppress_context__


def test_a_server_that_is_not_there():
    with socket.socket() as free:  # bound, but nobody listens
        free.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{free.getsockname()[1]}/a.png?sig={SECRET}"
        with pytest.raises(ImageReadError) as caught:
            read_url(url)
    assert str(caught.value) == f"cannot be read (Connection refused): {shown(url)}"


def test_files_that_are_no_pictures_or_too_large_ones(server, png):
    server.files |= {"/a.png": png[: len(png) // 2], "/b.png": b"no picture", "/c.png": b"", "/d.png": png}
    for name, reason in (("a", "is damaged"), ("b", "is not a picture"), ("c", "is empty"), ("d", "megapixels")):
        with pytest.raises(ImageReadError, match=rf"{reason}.*: {server.url}/{name}\.png$"):
            read_url(f"{server.url}/{name}.png?sig={SECRET}", ReadOptions(max_pixels=100))


def test_a_redirect_on_the_web_is_followed(server, png):
    server.files["/there.png"], server.manners["/here.png"] = png, "/there.png"
    assert read_url(f"{server.url}/here.png").path.name == "here.png"


def test_what_a_file_is_known_by(server, png):
    url = f"{server.url}/a.png"
    server.files["/a.png"] = png
    first = hash_of(url)
    assert hash_of(url) == hash_of(f"{url}?sig=another") == first
    assert {method for method, _ in server.asked} == {"HEAD"}
    server.files["/a.png"] = png[:-1]
    assert hash_of(url) != first
    for manner in ("untagged", "headless"):
        server.manners["/a.png"] = manner
        assert version_of(url) is None
        assert hash_of(url) == hashlib.sha256(png[:-1]).hexdigest()
    del server.files["/a.png"]
    with pytest.raises(ImageReadError, match="does not exist"):
        hash_of(url)


def test_files_are_put_whole_over_those_that_are_there(server, tmp_path):
    made = tmp_path / "made"
    for content in (b"first", b"second"):
        made.write_bytes(content)
        upload(made, f"file://{tmp_path}/new folder", "day 1/ü.bin")
        upload(made, "s3://bucket/new%20folder/", "day 1/ü.bin")
        upload(made, "s3://bucket", "ü.bin")
        assert (tmp_path / "new folder" / "day 1" / "ü.bin").read_bytes() == content
        assert server.files == dict.fromkeys(("/bucket/new%20folder/day%201/%C3%BC.bin", "/bucket/%C3%BC.bin"), content)


@pytest.mark.parametrize(
    ("status", "reason"),
    [(403, "permission denied"), (404, "does not exist"), (500, "the server says 500 Internal Server Error")],
)
def test_what_cannot_be_put(server, tmp_path, status, reason):
    (tmp_path / "made").write_bytes(b"x")
    server.answers["/bucket/a/b.png"] = status
    with pytest.raises(ImageWriteError) as caught:
        upload(tmp_path / "made", "s3://bucket/a", "b.png")
    assert str(caught.value) == f"cannot be uploaded ({reason}): s3://bucket/a/b.png"
    for name in ("../b.png", "\udcff.png"):
        with pytest.raises(ImageWriteError, match="cannot be uploaded"):
            upload(tmp_path / "made", "s3://bucket/a", name)


def test_without_the_package_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "obstore", None)
    for kind, check in ((ImageReadError, check_url), (ImageReadError, read_url), (ImageWriteError, check_upload)):
        with pytest.raises(kind, match=re.escape("(URLs need: pip install 'autoalign[remote]'): s3://b/k")):
            check("s3://b/k")
    check_url("file:///a.png")
