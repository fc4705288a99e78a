"""Metrics over HTTP, read by the parser of prometheus_client."""

import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest
from prometheus_client import Metric
from prometheus_client.metrics_core import GaugeMetricFamily
from prometheus_client.openmetrics.parser import text_string_to_metric_families
from prometheus_client.parser import text_string_to_metric_families as prometheus_families

from noack.runtime.connections import connection_gate
from noack.runtime.connections import metrics_server as servers
from noack.runtime.connections.metrics_server import metrics_server
from tests.helpers.approved import lines_of_error
from tests.helpers.metrics_readers import read, slow_reader


def collect() -> Iterator[Metric]:
    yield GaugeMetricFamily("noack_test", "a value", 2.5)


def collect_much() -> Iterator[Metric]:
    """More than the kernel takes of an answer that is not read."""
    yield GaugeMetricFamily("noack_test", "a" * 2**23, 2.5)


def answered(reader: socket.socket) -> bytes:
    """What a reader still gets, until the end of its connection."""
    found = b""
    with suppress(ConnectionResetError):
        while part := reader.recv(2**20):
            found += part
    return found


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


@pytest.mark.parametrize(
    "sent", [b"", b"GET /metr", b"GET / HTTP/1.1\r\nAccept: ", b"GET / HTTP/1.1\r\n\r\n"]
)
def test_readers_that_stall_keep_neither_others_nor_the_end_waiting(
    monkeypatch: pytest.MonkeyPatch, sent: bytes
) -> None:
    """Before the request, in its line, in its headers, and while the answer is sent."""
    monkeypatch.setattr(servers, "_REQUEST_S", 3600.0)
    monkeypatch.setattr(servers, "_ANSWER_S", 3600.0)
    with ExitStack() as stack:
        with metrics_server(":0", collect_much if sent.endswith(b"\n") else collect) as address:
            stalled = [stack.enter_context(socket.create_connection(address)) for _ in range(30)]
            for one in stalled:
                one.sendall(sent)
            assert "noack_test" in read(address)
        for one in stalled:
            one.settimeout(60)
            with suppress(ConnectionResetError):
                while one.recv(65_536):
                    pass


def test_a_request_has_a_time_limit_however_it_arrives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(servers, "_REQUEST_S", 0.0)
    monkeypatch.setattr(connection_gate, "_CHECK_S", 0.01)
    with metrics_server(":0", collect) as address, slow_reader(address) as thread:
        thread.join()


@pytest.mark.parametrize("sent", [b"\n\n", b"GET\r\n\r\n", b"\0 \0 \0\n\n", b"a" * 20_000])
def test_a_message_that_is_no_http_request_is_refused(sent: bytes) -> None:
    with metrics_server(":0", collect) as address, socket.create_connection(address) as reader:
        reader.settimeout(60)
        with suppress(ConnectionError):
            reader.sendall(sent)
            assert answered(reader) in (b"", b"HTTP/1.0 400 Bad Request\r\n\r\n")
        assert "noack_test" in read(address)


def test_an_address_of_another_host_and_a_missing_package_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refused(where: str) -> list[str]:
        return lines_of_error(lambda: metrics_server(where, collect).__enter__())

    assert refused("192.0.2.1:0") == ["--metrics 192.0.2.1:0: Cannot assign requested address"]
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    (line,) = refused(":0")
    assert "pip install 'noack[metrics]'" in line
