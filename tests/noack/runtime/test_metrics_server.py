"""Metrics over HTTP, read by the parser of prometheus_client."""

import socket
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from prometheus_client import Metric
from prometheus_client.metrics_core import GaugeMetricFamily
from prometheus_client.openmetrics.parser import text_string_to_metric_families
from prometheus_client.parser import text_string_to_metric_families as prometheus_families

from noack.core.errors import CallerError
from noack.runtime import metrics_server as servers
from noack.runtime.address import Address
from noack.runtime.metrics_server import metrics_server

OPENMETRICS = "application/openmetrics-text; version=1.0.0"


def collect() -> Iterator[Metric]:
    yield GaugeMetricFamily("noack_test", "a value", 2.5)


def read(address: Address, accept: str = OPENMETRICS, method: str = "GET") -> str:
    request = urllib.request.Request(
        f"http://{address[0]}:{address[1]}/metrics", headers={"Accept": accept}, method=method
    )
    with urllib.request.urlopen(request, timeout=30) as answer:
        return str(answer.read().decode())


def test_metrics_are_read_in_both_formats() -> None:
    with metrics_server(":0", collect) as address:
        assert address[0] == "127.0.0.1"
        (family,) = text_string_to_metric_families(read(address))
        assert (family.name, family.samples[0].value) == ("noack_test", 2.5)
        (family,) = prometheus_families(read(address, accept="*/*"))
        assert family.samples[0].value == 2.5
        with pytest.raises(urllib.error.HTTPError, match="405"):
            read(address, method="POST")
    with pytest.raises(urllib.error.URLError):
        read(address)


def test_readers_that_send_nothing_or_garbage_do_not_stop_it(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with metrics_server("127.0.0.1:0", collect) as address:
        silent = [socket.create_connection(address) for _ in range(2)]
        with socket.create_connection(address) as garbage:
            garbage.sendall(b"\x00\xff" * 40_000)
        silent[0].close()
        silent[1].shutdown(socket.SHUT_RDWR)
        assert "noack_test" in read(address)
        silent[1].close()
    assert capfd.readouterr().err == ""


STALLED = {
    "before the request": b"",
    "in the request line": b"GET /met",
    "in a header": b"GET / HTTP/1.1\r\nHost: a",
    "before the empty line": b"GET / HTTP/1.1\r\nHost: a\r\n",
}


@pytest.mark.parametrize("begun", STALLED.values(), ids=STALLED.keys())
def test_a_reader_that_stalls_keeps_neither_another_reader_nor_the_end_waiting(
    begun: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(servers, "_CONNECTION_S", 1e5)
    with metrics_server(":0", collect) as address:
        stalled = [socket.create_connection(address, 60) for _ in range(3)]
        for one in stalled:
            one.sendall(begun)
        assert "noack_test" in read(address)
    for one in stalled:  # the end of the server ended them
        with one:
            assert one.recv(1) == b""


def test_a_reader_of_a_large_answer_that_stalls_does_not_keep_the_end_waiting() -> None:
    def large() -> Iterator[Metric]:
        family = GaugeMetricFamily("noack_test", "a value", labels=["name"])
        for number in range(2_000):
            family.add_metric([f"{number:09d}" * 1000], 1.0)
        yield family

    with metrics_server(":0", large) as address, socket.create_connection(address, 60) as one:
        one.sendall(b"GET / HTTP/1.0\r\n\r\n")
        assert one.recv(1) == b"H"  # the answer, 18 MB, has begun


def test_a_connection_ends_at_its_time_limit_however_slowly_it_sends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(servers, "_CONNECTION_S", 0.2)
    with metrics_server(":0", collect) as address, socket.create_connection(address, 60) as one:

        def send_slowly() -> None:
            while True:  # until the server has ended the connection
                one.sendall(b"G")
                time.sleep(0.01)

        with pytest.raises(ConnectionError):
            send_slowly()


def test_of_too_many_connections_the_oldest_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servers, "_CONNECTION_S", 1e5)
    monkeypatch.setattr(servers, "_MOST_CONNECTIONS", 3)
    with metrics_server(":0", collect) as address, ExitStack() as stack:
        several = [stack.enter_context(socket.create_connection(address, 60)) for _ in range(8)]
        assert "noack_test" in read(address)
        for one in several[:6]:
            assert one.recv(1) == b""
        several[-1].sendall(b"GET / HTTP/1.0\r\n\r\n")
        assert several[-1].recv(1) == b"H"


@pytest.mark.parametrize(("where", "message"), [
    ("nowhere", "--metrics: expected HOST:PORT"),
    ("127.0.0.1:99999", "--metrics: expected HOST:PORT"),
    ("192.0.2.1:0", "--metrics 192.0.2.1:0: Cannot assign requested address"),
])  # fmt: skip
def test_a_wrong_address_gives_one_line(where: str, message: str) -> None:
    with pytest.raises(CallerError) as caught, metrics_server(where, collect):
        pass
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


def test_an_address_in_use_gives_one_line() -> None:
    with (
        metrics_server(":0", collect) as (host, port),
        pytest.raises(CallerError, match="Address already in use"),
        metrics_server(f"{host}:{port}", collect),
    ):
        pass


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    with (
        pytest.raises(CallerError, match=r"pip install 'noack\[metrics\]'"),
        metrics_server(":0", collect),
    ):
        pass
