"""Only whoever has the token comes in, by the address or by the cookie it gives."""

import asyncio

import pytest

from clients.web.guard import POLICY_VIOLATION, Guard

TOKEN = "a-token"
HOST = (b"host", b"127.0.0.1:8765")


async def _inside(scope, receive, send):
    kind = "http.response.start" if scope["type"] == "http" else "websocket.accept"
    await send({"type": kind, "status": 200})


def _asked(kind="http", query=b"", *headers):
    """Return what the guard sends, as dicts."""
    sent = []

    async def ask():
        scope = {"type": kind, "query_string": query, "headers": [HOST, *headers]}

        async def receive():
            return {"type": "websocket.connect"}

        async def send(message):
            sent.append(message)

        guard = Guard(_inside, token=TOKEN, cookie="ocufilter-8765")
        await guard(scope, receive, send)

    asyncio.run(ask())
    return sent


def _cookie(token=TOKEN):
    return (b"cookie", f"other=1; ocufilter-8765={token}".encode())


def test_the_token_in_the_address_becomes_a_cookie_and_leaves_the_address():
    start, _ = _asked("http", b"token=a-token")
    headers = dict(start["headers"])
    assert start["status"] == 303
    assert headers[b"location"] == b"/"
    assert headers[b"set-cookie"].startswith(b"ocufilter-8765=a-token; ")
    assert b"HttpOnly" in headers[b"set-cookie"]
    assert b"SameSite=Strict" in headers[b"set-cookie"]


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_the_cookie_lets_in(kind):
    (first,) = _asked(kind, b"", _cookie())
    assert first["type"] in ("http.response.start", "websocket.accept")
    assert first["status"] == 200


@pytest.mark.parametrize(
    ("query", "headers"),
    [
        (b"", ()),
        (b"token=", ()),
        (b"token=another", ()),
        (b"", (_cookie("another"),)),
        (b"", ((b"cookie", b"ocufilter-1=a-token"),)),
        (b"", ((b"cookie", b"\xff=;;="),)),
        (b"", (_cookie(), (b"origin", b"http://127.0.0.1:9999"))),
    ],
)
def test_everything_else_is_refused(query, headers):
    start, body = _asked("http", query, *headers)
    assert start["status"] == 403
    assert b"ocufilter web" in body["body"]
    (closed,) = _asked("websocket", query, *headers)
    assert closed == {"type": "websocket.close", "code": POLICY_VIOLATION}


def test_our_own_page_may_open_its_websocket():
    (first,) = _asked(
        "websocket", b"", _cookie(), (b"origin", b"http://127.0.0.1:8765")
    )
    assert first["type"] == "websocket.accept"
