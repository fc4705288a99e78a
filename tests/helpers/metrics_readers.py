"""Readers of metrics: over HTTP, slowly, and by the parsers of prometheus_client."""

import select
import socket
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from prometheus_client import CollectorRegistry
from prometheus_client.openmetrics.exposition import generate_latest
from prometheus_client.openmetrics.parser import text_string_to_metric_families

from noack.runtime.address import Address

OPENMETRICS = "application/openmetrics-text; version=1.0.0"
Values = dict[str, float]


def values_of(text: str) -> Values:
    """The value of each sample, by its name and its labels."""
    return {
        ",".join([sample.name, *sorted(sample.labels.values())]): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def exposed(collector: object) -> str:
    """Return the metrics of a collector as text."""
    registry = CollectorRegistry()
    registry.register(collector)  # type: ignore[arg-type]
    return str(generate_latest(registry).decode())


@contextmanager
def slow_reader(address: Address) -> Iterator[threading.Thread]:
    """Send a request of endless length, byte by byte; yield the thread, which ends with the
    connection."""

    def send() -> None:
        with suppress(OSError):
            while not select.select([connection], [], [], 0.01)[0]:
                connection.send(b"G")

    with socket.create_connection(address) as connection:
        thread = threading.Thread(target=send)
        thread.start()
        try:
            yield thread
        finally:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            thread.join()


def read(address: Address, accept: str = OPENMETRICS, method: str = "GET") -> str:
    """Return the metrics that are served at an address."""
    request = urllib.request.Request(
        f"http://{address[0]}:{address[1]}/metrics", headers={"Accept": accept}, method=method
    )
    with urllib.request.urlopen(request, timeout=30) as answer:
        return str(answer.read().decode())
