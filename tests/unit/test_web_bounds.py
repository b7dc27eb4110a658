"""Requests beyond the page's limits are answered before they take memory or time."""

import asyncio

import pytest

from clients.web.guard import Bounds, Limits, plain_name

LIMITS = Limits(message_bytes=100, upload_bytes=1000, body_s=0.2, uploads=2)
UPLOAD = "/_nicegui/client/an-id/upload/7"
MESSAGE = "/_nicegui_ws/socket.io/"


class Inside:
    """An application that reads the whole body, as NiceGUI does."""

    def __init__(self):
        self.n_bytes = self.n_requests = 0

    async def __call__(self, scope, receive, send):
        self.n_requests += 1
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                raise RuntimeError("the client is gone")
            self.n_bytes += len(message["body"])
            if not message["more_body"]:
                break
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})


def _scope(path="/", method="GET", length=None):
    headers = [] if length is None else [(b"content-length", str(length).encode())]
    return {"type": "http", "method": method, "path": path, "headers": headers}


def _asked(scope, parts=(b"",), inside=None, **options):
    """Return the status of the answer; None where there is none."""
    bounds = Bounds(inside or Inside(), limits=LIMITS, **options)
    waiting, sent = list(parts), []

    async def receive():
        part = waiting.pop(0)
        if part == "gone":
            return {"type": "http.disconnect"}
        if part == "nothing":
            await asyncio.sleep(30)
        return {"type": "http.request", "body": part, "more_body": bool(waiting)}

    async def send(message):
        sent.append(message)

    asyncio.run(bounds(scope, receive, send))
    statuses = [m["status"] for m in sent if m["type"] == "http.response.start"]
    assert len(statuses) <= 1
    return statuses[0] if statuses else None


def test_what_is_within_the_limits_is_passed_on():
    inside = Inside()
    assert _asked(_scope(), inside=inside) == 200
    assert _asked(_scope(MESSAGE, "POST", 100), [b"x" * 100], inside) == 200
    assert _asked(_scope(UPLOAD, "POST"), [b"x" * 500, b"x" * 500], inside) == 200
    assert inside.n_bytes == 1100


@pytest.mark.parametrize(
    ("path", "most"), [(UPLOAD, 1000), (MESSAGE, 100), ("/", 100), ("/upload/", 0)]
)
def test_a_body_that_announces_too_much_is_not_read(path, most):
    inside = Inside()
    for length in (most + 1, 10**12):
        expected = 404 if path == "/upload/" else 413
        assert _asked(_scope(path, "POST", length), inside=inside) == expected
    assert inside.n_requests == 0


@pytest.mark.parametrize("length", ["-1", "1e9", "0x10", "9" * 5000, "\u00b2"])
def test_a_length_that_is_none_is_refused(length):
    scope = _scope(UPLOAD, "POST", length)
    scope["headers"] = [(b"content-length", length.encode("latin-1"))]
    assert _asked(scope) == 400


def test_a_body_that_does_not_say_how_long_it_is_ends_at_the_limit():
    inside = Inside()
    assert _asked(_scope(UPLOAD, "POST"), 100 * [b"x" * 300], inside) == 413
    assert inside.n_bytes == 900


def test_a_body_that_does_not_come_is_not_waited_for():
    assert _asked(_scope(UPLOAD, "POST"), [b"x", "nothing"]) == 408


def test_a_client_that_goes_in_mid_body_is_no_error_of_ours():
    assert _asked(_scope(UPLOAD, "POST"), [b"x", "gone"]) is None


def test_an_error_of_ours_stays_one():
    async def broken(scope, receive, send):
        await receive()
        raise RuntimeError("ours")

    with pytest.raises(RuntimeError, match="ours"):
        _asked(_scope(), inside=broken)


@pytest.mark.parametrize(
    "method", ["PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "PROPFIND", ""]
)
def test_other_methods_are_refused(method):
    assert _asked(_scope("/", method)) == 405


@pytest.mark.parametrize(
    "path",
    ["/x", "/etc/passwd", "/../etc/passwd", "//", "/_nicegui", "/_nicegui/a\0b", ""],
)
def test_addresses_that_are_none_are_refused(path):
    assert _asked(_scope(path)) == 404


def test_the_number_of_pages_is_limited():
    assert _asked(_scope(), is_full=lambda: True) == 503
    assert _asked(_scope("/_nicegui/x"), is_full=lambda: True) == 200


def test_the_number_of_uploads_at_a_time_is_limited():
    statuses = []

    async def ask():
        bounds = Bounds(Inside(), limits=LIMITS)

        async def one():
            async def receive():
                await asyncio.sleep(0.05)
                return {"type": "http.request", "body": b"x", "more_body": False}

            async def send(message):
                if message["type"] == "http.response.start":
                    statuses.append(message["status"])

            await bounds(_scope(UPLOAD, "POST"), receive, send)

        await asyncio.gather(*(one() for _ in range(5)))
        await one()  # they are over

    asyncio.run(ask())
    assert sorted(statuses) == [200, 200, 200, 503, 503, 503]


@pytest.mark.parametrize(
    ("sent", "expected"),
    [
        ("photo.png", "photo.png"),
        ("../../etc/passwd", "passwd"),
        ("C:\\temp\\a.glb", "a.glb"),
        ("a\0b\n.png", "ab.png"),
        ("\u202egnp.exe", "gnp.exe"),
        ("\ud800.png", "png"),
        ("..", "unnamed"),
        ("", "unnamed"),
        ("x" * 5000 + ".png", "x" * 60 + ".png"),
        ("x." + "y" * 5000, "x." + "y" * 7),
    ],
)
def test_names_of_files_are_made_safe(sent, expected):
    assert plain_name(sent) == expected
