"""Metrics over HTTP, read by the parser of prometheus_client."""

import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest
from prometheus_client import Metric
from prometheus_client.metrics_core import GaugeMetricFamily
from prometheus_client.openmetrics.parser import text_string_to_metric_families
from prometheus_client.parser import text_string_to_metric_families as prometheus_families

from noack.core.errors import CallerError
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
