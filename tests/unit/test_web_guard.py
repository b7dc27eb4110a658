"""Only whoever has the token comes in, by the address or by the cookie it gives."""

import asyncio
import time

import pytest

from clients.web.guard import POLICY_VIOLATION, Guard
from clients.web.program import hosts_of, open_socket

TOKEN = "a-token"
HOST = (b"host", b"127.0.0.1:8765")


async def _inside(scope, receive, send):
    kind = "http.response.start" if scope["type"] == "http" else "websocket.accept"
    await send({"type": kind, "status": 200})


def _asked(
    kind="http", query=b"", *headers, host=HOST, guard=None, scheme="http", **options
):
    """Return what the guard sends, as dicts."""
    sent = []
    if guard is None:
        guard = Guard(_inside, token=TOKEN, cookie="ocufilter-8765", **options)

    async def ask():
        scope = {"type": kind, "query_string": query, "headers": [host, *headers]}
        scope["scheme"] = scheme

        async def receive():
            return {"type": "websocket.connect"}

        async def send(message):
            sent.append(message)

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
    assert b"SameSite=Lax" in headers[b"set-cookie"]


@pytest.mark.parametrize(("scheme", "is_secure"), [("http", False), ("https", True)])
def test_the_cookie_is_secure_if_the_page_is_read_through_tls(scheme, is_secure):
    start, _ = _asked("http", b"token=a-token", scheme=scheme)
    cookie = dict(start["headers"])[b"set-cookie"]
    assert (b"; Secure" in cookie) == is_secure


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
        (b"", (_cookie(), (b"origin", b"null"))),
        (b"", (_cookie(), (b"origin", b"http://[::1"))),
        (b"", (_cookie(), (b"sec-fetch-site", b"same-site"))),
        (b"", (_cookie(), (b"sec-fetch-site", b"cross-site"))),
        (
            b"",
            (
                _cookie(),
                (b"sec-fetch-site", b"same-site"),
                (b"sec-fetch-mode", b"navigate"),
                (b"sec-fetch-dest", b"iframe"),
            ),
        ),
    ],
)
def test_everything_else_is_refused(query, headers):
    start, body = _asked("http", query, *headers)
    assert start["status"] == 403
    assert b"ocufilter web" in body["body"]
    (closed,) = _asked("websocket", query, *headers)
    assert closed == {"type": "websocket.close", "code": POLICY_VIOLATION}


def test_events_of_the_server_need_no_token():
    """They have no headers: the server starts only if they are passed on."""
    scopes = []

    async def inside(scope, _receive, _send):
        scopes.append(scope)

    guard = Guard(inside, token=TOKEN, cookie="ocufilter-8765", hosts=LOCAL)
    asyncio.run(guard({"type": "lifespan"}, None, None))
    assert scopes == [{"type": "lifespan"}]


def test_our_own_page_may_open_its_websocket():
    (first,) = _asked(
        "websocket", b"", _cookie(), (b"origin", b"http://127.0.0.1:8765")
    )
    assert first["type"] == "websocket.accept"


def test_another_site_may_link_to_the_page():
    headers = (
        (b"sec-fetch-site", b"same-site"),
        (b"sec-fetch-mode", b"navigate"),
        (b"sec-fetch-dest", b"document"),
    )
    (first,) = _asked("http", b"", _cookie(), *headers)
    assert first["status"] == 200


LOCAL = frozenset({"localhost", "127.0.0.1", "::1"})


@pytest.mark.parametrize(
    "host",
    [
        b"evil.com",
        b"evil.com:8765",
        b"127.0.0.1.evil.com",
        b"localhost@evil.com",
        b"evil.com#localhost",
        b"[::1",
        b"",
    ],
)
def test_a_name_of_another_site_is_refused_even_with_the_token(host):
    """DNS rebinding: the browser finds us under the name of another site."""
    for headers in ((_cookie(),), (_cookie(), (b"origin", b"http://" + host))):
        start, _ = _asked(
            "http", b"token=a-token", *headers, host=(b"host", host), hosts=LOCAL
        )
        assert start["status"] == 421
        (closed,) = _asked(
            "websocket", b"", *headers, host=(b"host", host), hosts=LOCAL
        )
        assert closed == {"type": "websocket.close", "code": POLICY_VIOLATION}


@pytest.mark.parametrize("host", [b"localhost:1", b"LOCALHOST", b"[::1]:8765"])
def test_names_of_this_machine_are_answered(host):
    (first,) = _asked("http", b"", _cookie(), host=(b"host", host), hosts=LOCAL)
    assert first["status"] == 200


@pytest.mark.parametrize(
    ("address", "names", "expected"),
    [
        ("127.0.0.1", [], {"localhost", "127.0.0.1", "::1"}),
        ("127.0.0.2", [], {"localhost", "127.0.0.1", "::1", "127.0.0.2"}),
        ("127.0.0.1", ["Eye.Org"], {"localhost", "127.0.0.1", "::1", "eye.org"}),
        ("0.0.0.0", [], None),
        ("0", [], None),  # the system takes it for 0.0.0.0
    ],
)
def test_names_are_limited_where_only_this_machine_is_let_in(address, names, expected):
    with open_socket(address, 0) as listening:
        assert hosts_of(listening, names) == expected


def test_an_empty_host_does_not_let_other_machines_in():
    with pytest.raises(ValueError, match="--host is empty"):
        open_socket("", 0)


def test_the_token_of_the_browsers_command_line_works_once():
    guard = Guard(_inside, token=TOKEN, cookie="ocufilter-8765", one_time_token="once")
    start, _ = _asked("http", b"token=once", guard=guard)
    assert start["status"] == 303
    assert dict(start["headers"])[b"set-cookie"].startswith(b"ocufilter-8765=a-token;")
    start, _ = _asked("http", b"token=once", guard=guard)
    assert start["status"] == 403
    start, _ = _asked("http", b"token=a-token", guard=guard)
    assert start["status"] == 303


def test_a_cookie_of_backslashes_takes_no_time():
    """http.cookies takes 3 s for it, in the event loop, before any token is asked."""
    header = b'a="' + 30_000 * b"\\" + b'"'
    begin_s = time.perf_counter()
    start, _ = _asked("http", b"", (b"cookie", header))
    assert time.perf_counter() - begin_s < 0.5
    assert start["status"] == 403


def test_another_programs_cookie_does_not_hide_ours():
    header = b'theirs={"a": [1, 2]}; ocufilter-8765=a-token'
    (first,) = _asked("http", b"", (b"cookie", header))
    assert first["status"] == 200


def test_other_pages_can_neither_frame_nor_embed_the_page():
    for query, headers in ((b"", (_cookie(),)), (b"", ()), (b"token=a-token", ())):
        start, *_ = _asked("http", query, *headers)
        found = dict(start.get("headers", ()))
        assert found[b"x-frame-options"] == b"DENY"
        assert found[b"content-security-policy"] == b"frame-ancestors 'none'"
        assert found[b"x-content-type-options"] == b"nosniff"
