"""A hostile client and a real page: it stays up, answers, and tells nothing."""

import http.client
import io
import json
import os
import re
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
import uvicorn
from PIL import Image

from clients.web.guard import MAX_MESSAGE_BYTES, MAX_PAGES, MAX_UPLOAD_BYTES
from clients.web.server import MAX_HEAD_BYTES, BoundedConnection
from tests.source_tree import ROOT

TIMEOUT_S = 20.0
GONE_S = 6.0
"""NiceGUI forgets a page that has been closed for 3 s."""


class Target:
    """The program under attack, and who attacks it with the cookie or without."""

    def __init__(self, address: str, pid: int) -> None:
        self.address = address
        self.port = urlsplit(address).port
        self.pid = pid
        status, headers, _ = self.ask("GET", "/?" + urlsplit(address).query)
        assert status == 303
        self.cookie = {"Cookie": headers["set-cookie"].partition(";")[0]}

    def ask(self, method, path, body=None, headers=()):
        """Return status, headers and body of one answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, TIMEOUT_S)
        try:
            connection.request(method, path, body, dict(headers))
            answer = connection.getresponse()
            return answer.status, answer.headers, answer.read()
        finally:
            connection.close()

    def ask_inside(self, method, path, body=None, **headers):
        """Return status and body of an answer to one who has the cookie."""
        headers = self.cookie | {k.replace("_", "-"): v for k, v in headers.items()}
        status, _, content = self.ask(method, path, body, headers)
        return status, content

    def connect(self):
        return socket.create_connection(("127.0.0.1", self.port), TIMEOUT_S)

    def memory_mb(self) -> float:
        status = Path(f"/proc/{self.pid}/status").read_text(encoding="utf-8")
        return 1.024e-3 * int(re.search(r"VmRSS:\s+(\d+) kB", status)[1])

    def answers(self) -> bool:
        return self.ask_inside("GET", "/favicon.ico")[0] == 200


@contextmanager
def attacked(*options):
    """Start the program; in the end it still answers, and has told of no fault."""
    command = [sys.executable, "-m", "ocufilter", "web"]
    command += ["--no-browser", "--port", "0", "--json", *options]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as program:
        said = []  # read all the while: a full pipe would stop the program
        reader = threading.Thread(target=lambda: said.extend(program.stderr))
        reader.start()
        try:
            address = json.loads(program.stdout.readline())["address"]
            target = Target(address, program.pid)
            yield target
            assert target.answers()
        finally:
            program.terminate()
            program.wait(timeout=60)
            reader.join()
    text = "".join(said)
    assert "Traceback" not in text, text


@pytest.fixture(scope="module")
def target():
    with attacked() as target:
        yield target


def _refused(sock) -> bytes:
    """Return what comes until the other side closes; empty where it was cut."""
    try:
        return b"".join(iter(lambda: sock.recv(65536), b""))
    except ConnectionError:
        return b""


def test_a_flood_of_headers_is_cut_off(target):
    before_mb = target.memory_mb()
    sent = 0
    with target.connect() as sock, pytest.raises(ConnectionError):
        sock.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        for _ in range(1000):
            sock.sendall(1000 * (b"X: " + 95 * b"y" + b"\r\n"))
            sent += 1000 * 100
    assert sent < 5_000_000
    assert target.memory_mb() < before_mb + 20


@pytest.mark.parametrize(
    "head",
    [
        b"GET /" + MAX_HEAD_BYTES * b"a",
        b"GET / HTTP/1.1\r\nHost: " + MAX_HEAD_BYTES * b"a",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n",
        b"GET / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: -1\r\n\r\n",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 3\r\n"
        b"Content-Length: 4\r\n\r\n",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"\0\0\0\0\r\n\r\n",
    ],
)
def test_what_is_no_request_is_refused(target, head):
    with target.connect() as sock:
        sock.sendall(head)
        assert _refused(sock)[:10] in (b"HTTP/1.1 4", b"")


def test_who_is_refused_cannot_go_on_sending(target):
    with target.connect() as sock, pytest.raises(ConnectionError):
        sock.sendall(
            b"POST /_nicegui/client/x/upload/1 HTTP/1.1\r\nHost: 127.0.0.1\r\n"
            b"Content-Length: 999999999999\r\n\r\n"
        )
        for _ in range(2000):
            sock.sendall(100_000 * b"x")


def test_a_log_that_nobody_reads_stops_no_visitor():
    """Whoever has no token can cause as many lines as it likes."""
    reading, writing = os.pipe2(os.O_NONBLOCK)
    with suppress(BlockingIOError):
        while True:
            os.write(writing, 65536 * b"x")
    os.set_blocking(writing, True)
    command = [sys.executable, "-m", "ocufilter", "web"]
    command += ["--no-browser", "--port", "0", "--json"]
    with subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=writing, text=True
    ) as program:
        try:
            address = json.loads(program.stdout.readline())["address"]
            target = Target(address, program.pid)
            for _ in range(20):
                with target.connect() as sock:
                    sock.sendall(b"no request\r\n\r\n")
                    _refused(sock)
            assert target.answers()
        finally:
            program.kill()
            os.close(reading)
            os.close(writing)


@pytest.mark.parametrize("host", ["evil.com", "127.0.0.1.evil.com", "[::1", "a@b:c:d"])
def test_the_name_of_another_site_is_refused(target, host):
    assert target.ask_inside("GET", "/", Host=host)[0] == 421


@pytest.mark.parametrize("origin", ["null", "http://evil.com", "http://[::1", "//"])
def test_another_origin_is_refused(target, origin):
    for path in ("/", "/_nicegui_ws/socket.io/?EIO=4&transport=polling"):
        assert target.ask_inside("GET", path, Origin=origin)[0] == 403


@pytest.mark.parametrize(
    "path",
    [
        "/../../etc/passwd",
        "/..%2f..%2fetc/passwd",
        "/etc/passwd",
        "//etc/passwd",
        "/pictures/../../etc/passwd",
        "/_nicegui/VERSION/static/../../../../../../../../etc/passwd",
        "/_nicegui/VERSION/static/..%2f..%2f..%2f..%2f..%2f..%2fetc/passwd",
        "/_nicegui/VERSION/static//etc/passwd",
        "/_nicegui/VERSION/static/%00",
        "/_nicegui/VERSION/static/" + 5000 * "a",
        "/_nicegui/VERSION/resources/KEY/..%2f..%2f..%2f..%2fetc/passwd",
        "/_nicegui/VERSION/resources/KEY//etc/passwd",
        "/_nicegui/VERSION/esm/KEY/..%2f..%2f..%2f..%2fetc/passwd",
        "/_nicegui/VERSION/components/..%2f..%2f..%2fetc/passwd",
        "/_nicegui/VERSION/libraries/..%2f..%2f..%2fetc/passwd.map",
        "/%ff%fe",
    ],
)
def test_no_path_leads_out(target, path):
    for number in ("x", version("nicegui")):
        wanted = path.replace("VERSION", number).replace("KEY", "leaflet")
        status, content = target.ask_inside("GET", wanted)
        assert status in (403, 404, 405)
        assert b"root:" not in content
        assert b"Traceback" not in content


@pytest.mark.parametrize("method", ["PUT", "DELETE", "OPTIONS", "TRACE", "PROPFIND"])
def test_other_methods_are_refused(target, method):
    assert target.ask_inside(method, "/")[0] == 405


def test_a_body_too_large_is_refused_before_it_is_sent(target):
    upload = "/_nicegui/client/x/upload/1"
    for path, most in ((upload, MAX_UPLOAD_BYTES), ("/", MAX_MESSAGE_BYTES)):
        length = str(most + 1)
        status, content = target.ask_inside("POST", path, Content_Length=length)
        assert status == 413
        assert b"Too large" in content


def test_a_body_without_a_length_ends_at_the_limit(target):
    before_mb = target.memory_mb()
    path = "/_nicegui_ws/socket.io/?EIO=4&transport=polling"
    _, opened = target.ask_inside("GET", path)
    sid = json.loads(opened[1:])["sid"]
    head = f"POST {path}&sid={sid} HTTP/1.1\r\nHost: 127.0.0.1\r\n"
    head += f"Cookie: {target.cookie['Cookie']}\r\nTransfer-Encoding: chunked\r\n\r\n"
    with target.connect() as sock, pytest.raises(ConnectionError):
        sock.sendall(head.encode())
        for _ in range(1000):  # 100 MB
            sock.sendall(b"186a0\r\n" + 100_000 * b"x" + b"\r\n")
    assert target.memory_mb() < before_mb + 30


@pytest.mark.parametrize(
    ("options", "protocol", "is_secure"),
    [
        ((), "https", False),
        (("--proxy-host", "eye.example.org"), "http", False),
        (("--proxy-host", "eye.example.org"), "https", True),
    ],
)
def test_the_cookie_is_secure_behind_a_proxy_with_tls(options, protocol, is_secure):
    with attacked(*options) as target:
        query = urlsplit(target.address).query
        forwarded = {"X-Forwarded-Proto": protocol}
        _, headers, _ = target.ask("GET", "/?" + query, None, forwarded)
        assert ("; Secure" in headers["set-cookie"]) == is_secure


def test_pages_that_nobody_looks_at_are_limited(target):
    statuses = [target.ask_inside("GET", "/")[0] for _ in range(MAX_PAGES + 8)]
    assert statuses[0] == 200
    assert statuses[-1] == 503
    assert 503 not in statuses[: MAX_PAGES // 2]


def test_pages_loaded_at_once_are_all_served_up_to_the_limit():
    """Building them takes longer together than NiceGUI waits for one."""
    for n_loads in (12, MAX_PAGES + 20):
        with attacked() as target, ThreadPoolExecutor(n_loads) as pool:
            loads = range(n_loads)
            answers = pool.map(lambda _: target.ask_inside("GET", "/")[0], loads)
            statuses = Counter(answers)
        assert statuses == Counter({200: min(n_loads, MAX_PAGES)}) + Counter(
            {503: max(n_loads - MAX_PAGES, 0)}
        )


# --- what is sent from the page ------------------------------------------------


def photo_entry(browser, target):
    """Open a page; return it and the path that a photo is sent to."""
    page = browser.new_context().new_page()
    page.goto(target.address)
    page.get_by_role("button", name="Photo", exact=True).first.click()
    with page.expect_request(lambda request: "/upload/" in request.url) as sent:
        entry = page.locator(".oc-uploads input[type=file]").first
        picture = {"name": "a.png", "mimeType": "image/png", "buffer": b"none"}
        entry.set_input_files(picture)
    return page, urlsplit(sent.value.url).path


class Upload:
    """Sends to the entry of a photo what no browser would send."""

    def __init__(self, browser, target) -> None:
        self.browser, self.target, self.page = browser, target, None

    def open(self):
        """Open a page, or another where a busy machine has lost the last one."""
        if self.page is None or self(b"a.png", b"") == 404:
            self.page, self.path = photo_entry(self.browser, self.target)
        return self

    def __call__(self, name: bytes, content: bytes):
        body = b'--B\r\nContent-Disposition: form-data; name="f"; filename="'
        body += name + b'"\r\nContent-Type: image/png\r\n\r\n' + content
        kinds = "multipart/form-data; boundary=B"
        status, _ = self.target.ask_inside(
            "POST", self.path, body + b"\r\n--B--\r\n", Content_Type=kinds
        )
        return status


@pytest.fixture(scope="module")
def module_upload(browser):
    with attacked() as target:
        upload = Upload(browser, target)
        yield upload
        upload.page.context.close()


@pytest.fixture
def upload(module_upload):
    return module_upload.open()


def _png(width_px, height_px):
    file = io.BytesIO()
    Image.fromarray(np.zeros((height_px, width_px), np.uint8)).save(file, "png")
    return file.getvalue()


def _said(upload, pattern):
    words = upload.page.locator(".oc-problem").filter(has_text=re.compile(pattern))
    words.first.wait_for(timeout=1000 * TIMEOUT_S)
    return words.first.inner_text()


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        (b"../../../etc/passwd", "'passwd'"),
        (b"..\\..\\boot.ini", "'boot.ini'"),
        (b"a\x00b.png", "'ab.png'"),
        (500 * b"long" + b".png", "'longlong"),
        (b"<img src=x onerror=alert(1)>.png", "'<img"),
        (b"\xff\xfe\xed\xa0\x80.gif", "not a picture"),
    ],
)
def test_a_hostile_name_is_only_shown(upload, name, shown):
    assert upload(name, b"GIF89a no picture") == 200
    text = _said(upload, re.escape(shown))
    assert "not a picture" in text
    assert len(text) < 300


def test_a_bomb_is_refused(upload):
    assert upload(b"bomb.png", _png(9000, 8001)) == 200
    assert "allowed: at most" in _said(upload, "bomb.png.*pixels")


def test_a_page_that_closes_during_an_upload_is_no_fault(browser):
    """Its connection breaks, or the rest of the file comes when the page is gone."""
    with attacked() as target:
        page, path = photo_entry(browser, target)
        body = b'--B\r\nContent-Disposition: form-data; name="f"; filename="a.png"\r\n'
        body += b"Content-Type: image/png\r\n\r\n" + _png(4000, 3000) + b"\r\n--B--\r\n"
        head = (
            f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1:{target.port}\r\n"
            f"Cookie: {target.cookie['Cookie']}\r\n"
            "Content-Type: multipart/form-data; boundary=B\r\n"
            f"Content-Length: {len(body)}\r\n\r\n"
        ).encode()
        half = len(body) // 2
        with target.connect() as broken, target.connect() as late:
            for sock in (broken, late):
                sock.sendall(head + body[:half])
            time.sleep(0.3)
            page.context.close()
            broken.close()
            time.sleep(GONE_S)
            late.sendall(body[half:])
            assert late.recv(12).startswith(b"HTTP/1.1")


def test_uploads_that_are_none_are_refused(upload):
    ask, path = upload.target.ask_inside, upload.path
    kinds = {"Content_Type": "multipart/form-data; boundary=B"}
    assert ask("POST", path, b"", **kinds)[0] in (200, 400)
    assert ask("POST", path, b"--B\r\njunk", **kinds)[0] in (200, 400)
    many = 2000 * b'--B\r\nContent-Disposition: form-data; name="f"\r\n\r\n\r\n'
    assert ask("POST", path, many, **kinds)[0] == 400
    other = {"Content_Type": "application/json"}
    assert ask("POST", path, b"{}", **other)[0] in (200, 400)
    assert ask("POST", path + "9", b"--B", **kinds)[0] == 404


def test_events_of_wrong_values_leave_the_page_as_it_is(upload):
    """As one may send them from the console of a browser."""
    page = upload.page
    n_sent = page.evaluate("""async () => {
      const emit = window.socket.emit.bind(window.socket), told = [];
      window.socket.emit = (kind, what) => {
        if (kind === "event") told.push(what);
        return emit(kind, what);
      };
      const slider = document.querySelector(".oc-slider input[data-name=gaze_h_deg]");
      slider.value = Number(slider.value) + 5;
      slider.dispatchEvent(new Event("input", {bubbles: true}));
      await new Promise(done => setTimeout(done, 1000));
      const sent = [...told];
      for (const value of [1e300, -1e300, "far", null, [1], {}])
        for (const each of sent)
          emit("event", {...each, args: [JSON.stringify(value)]});
      return sent.length;
    }""")
    assert n_sent > 0
    # the thread that filters is alive: another picture, even a small one, is drawn
    # (numbers begin anew where a busy machine lost the connection and the page)
    page.evaluate("window.ocufilter && (window.ocufilter.drawn.length = 0)")
    page.get_by_role("button", name="Letter chart", exact=True).first.click()
    page.wait_for_function(
        "(window.ocufilter?.drawn ?? []).some(drawn => drawn.eye === 'OD')",
        timeout=60_000,
    )


# --- connections ---------------------------------------------------------------


@contextmanager
def serving(**limits):
    """Serve a small application with limits that tests can wait for."""

    async def application(scope, receive, send):
        if scope["type"] == "websocket":
            await receive()
            await send({"type": "websocket.accept"})
            while (message := await receive())["type"] == "websocket.receive":
                await send({"type": "websocket.send", "text": message["text"]})
            return
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"here"})

    connection = type("Connection", (BoundedConnection,), limits)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        config = uvicorn.Config(application, http=connection, lifespan="off")
        server = uvicorn.Server(config)
        options = {"sockets": [listening]}
        thread = threading.Thread(target=server.run, kwargs=options)
        thread.start()
        try:
            yield lambda: socket.create_connection(listening.getsockname(), TIMEOUT_S)
        finally:
            server.should_exit = True
            thread.join()


REQUEST = b"GET / HTTP/1.1\r\nHost: a\r\n\r\n"
UPGRADE = (
    b"Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)


@pytest.mark.parametrize("first", [b"", REQUEST])
def test_a_request_that_does_not_come_is_not_waited_for(first):
    """Slowloris: a byte now and then, at the beginning and in a kept connection."""
    with serving(head_s=0.4) as connect, connect() as sock:
        sock.sendall(first)
        if first:
            assert _answer(sock).startswith(b"HTTP/1.1 200")
        begin_s = time.monotonic()
        with pytest.raises(ConnectionError):
            for byte in REQUEST[:-2] + 100 * b"X-A: b\r\n":
                sock.sendall(bytes([byte]))
                time.sleep(0.05)
        assert time.monotonic() - begin_s < 2.0


def _answer(sock) -> bytes:
    """Return a whole answer in chunks, which may come in several pieces."""
    found = b""
    while not found.endswith(b"\r\n0\r\n\r\n"):
        piece = sock.recv(1000)
        assert piece, found
        found += piece
    return found


def get(connect):
    """Return the beginning of the answer to a request on a new connection."""
    with connect() as sock:
        sock.sendall(REQUEST)
        return sock.recv(1000)[:12]


def test_the_silent_connections_make_way_for_a_visitor():
    """With a limit that no test reaches for the time to send a request."""
    with serving(head_s=300.0, max_connections=4) as connect:
        with connect() as kept:
            kept.sendall(REQUEST)
            assert _answer(kept).startswith(b"HTTP/1.1 200")
            half = [connect() for _ in range(3)]
            for sock in half:
                sock.sendall(REQUEST[:-2])
            more = []
            for sock in half:  # each new one closes the oldest of the silent
                more.append(connect())
                more[-1].sendall(REQUEST[:-2])
                assert _refused(sock) == b""
                sock.close()
            assert get(connect) == b"HTTP/1.1 200"
            kept.sendall(REQUEST)
            assert _answer(kept).startswith(b"HTTP/1.1 200")
        for sock in more:
            sock.close()


def test_a_connection_in_use_does_not_make_way():
    with serving(max_connections=3) as connect:
        open_ones = [connect() for _ in range(3)]
        for sock in open_ones:
            sock.sendall(REQUEST[:-2] + UPGRADE)
            assert sock.recv(1000).startswith(b"HTTP/1.1 101")
        with connect() as fourth:
            assert _refused(fourth) == b""
        for sock in open_ones:
            sock.sendall(b"\x81\x82\0\0\0\0hi")
            assert sock.recv(1000) == b"\x81\x02hi"
            sock.close()
        deadline_s = time.monotonic() + TIMEOUT_S
        while (answer := get(connect)) != b"HTTP/1.1 200":
            assert time.monotonic() < deadline_s, answer


def test_a_connection_that_asks_again_and_again_stays():
    with serving(head_s=0.3) as connect, connect() as sock:
        for _ in range(8):
            sock.sendall(REQUEST)
            answer = b""
            while not answer.endswith(b"0\r\n\r\n"):
                answer += sock.recv(1000)
            assert answer.startswith(b"HTTP/1.1 200")
            time.sleep(0.1)


def test_a_websocket_is_no_request_that_is_waited_for():
    with serving(head_s=0.3) as connect, connect() as sock:
        sock.sendall(REQUEST[:-2] + UPGRADE)
        assert sock.recv(1000).startswith(b"HTTP/1.1 101")
        time.sleep(0.8)
        sock.sendall(b"\x81\x82\0\0\0\0hi")  # a text of two letters
        assert sock.recv(1000) == b"\x81\x02hi"
