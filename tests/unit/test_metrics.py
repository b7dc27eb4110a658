"""The metrics endpoint while other clients send slowly, in part or not at all."""

import socket
import threading
import urllib.request

import pytest

from filter_service.service.metrics import MAX_CONNECTIONS, METRICS, serve_metrics

HALF = b"GET /metrics HTTP/1.1\r\nHost: x\r\n"
LIMIT_S = 10.0


@pytest.fixture
def port():
    server = serve_metrics(0, lambda: dict.fromkeys(METRICS, 1.0))
    yield server.server_address[1]
    server.shutdown()
    server.server_close()


def get(port):
    url = f"http://127.0.0.1:{port}/metrics"
    with urllib.request.urlopen(url, timeout=LIMIT_S) as answer:
        return answer.read().decode()


@pytest.fixture
def connect(port):
    clients = []

    def open_one(opening=HALF):
        client = socket.create_connection(("127.0.0.1", port), timeout=LIMIT_S)
        client.sendall(opening)
        clients.append(client)
        return client

    yield open_one
    for client in clients:
        client.close()


def trickle(client, is_over):
    """Send a byte of a header every 0.1 s, until the server closes or the test ends."""
    try:
        while not is_over.wait(0.1):
            client.sendall(b"x")
    except OSError:
        return True
    return False


def test_a_client_that_sends_a_byte_at_a_time_delays_no_other(port, connect):
    is_over = threading.Event()
    slow = threading.Thread(target=trickle, args=[connect(), is_over])
    slow.start()
    try:
        assert "ocufilter_ready 1.0" in get(port)
    finally:
        is_over.set()
        slow.join()


def test_a_request_that_takes_too_long_is_ended_although_bytes_arrive(connect):
    is_over = threading.Event()
    end = threading.Timer(LIMIT_S, is_over.set)
    end.start()
    try:
        assert trickle(connect(), is_over), "the connection is still open"
    finally:
        end.cancel()


def test_beyond_the_limit_the_oldest_connection_is_closed(port, connect):
    clients = [connect() for _ in range(MAX_CONNECTIONS + 1)]
    assert clients[0].recv(1) == b""
    assert "ocufilter_ready 1.0" in get(port)


def test_a_head_without_end_is_refused(port, connect):
    client = connect(b"GET /metrics HTTP/1.1\r\nX: " + b"x" * 1_000_000)
    try:
        while client.recv(65536):
            pass
    except ConnectionError:
        pass
    assert "ocufilter_ready 1.0" in get(port)
