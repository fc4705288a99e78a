"""An emulator's statistics as metrics of OpenMetrics; the names begin with ``noack_netem_``.

A module of its own: prometheus_client is an optional package.
"""

import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from prometheus_client import Metric
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily

from netem.control.command_queue import CommandQueue
from netem.control.emulator_statistics import Statistics, statistics
from netem.relay.relay_reports import DIRECTIONS
from noack.core.clock import NS_PER_S
from noack.core.errors import PeerError

_PREFIX = "noack_netem"
_FRESH_S = 0.1
"""Newer statistics answer a further request, so that frequent readers do not load the relay."""

_LABELS = ["link", "direction"]
# By the metric's name: key of the statistics, label of a further key, text.
_OF_LINK = {
    "refused_datagrams": ("refused", "datagrams of clients beyond the limit"),
    "discarded_datagrams": ("discarded", "datagrams that no client waits for"),
    "port_unreachable": ("port_unreachable", "answers that no process listens"),
}
_COUNTERS = {
    "received_datagrams": ("received", "datagrams received"),
    "received_bytes": ("received_bytes", "bytes received, payload only"),
    "forwarded_datagrams": ("forwarded", "datagrams forwarded, copies included"),
    "forwarded_bytes": ("forwarded_bytes", "bytes forwarded, payload only"),
    "duplicated_datagrams": ("duplicated", "copies made"),
    "stale_datagrams": ("delivered_out_of_order", "datagrams delivered out of order"),
    "held_back_datagrams": ("held_back", "datagrams held back for the guarantee"),
}
_GAUGES = {
    "in_flight_datagrams": ("in_flight", "datagrams inside the emulator"),
    "longest_loss_burst": (
        "longest_loss_burst",
        "most consecutive losses of a flow under the present settings",
    ),
    "loss_burst_limit": ("mansd", "most consecutive losses that the guarantee allows (M - 1)"),
}
_LOSSES = {
    "loss_ratio": (
        "realised",
        "share of the datagrams not effectively delivered, present settings",
    ),
    "predicted_loss_ratio": ("predicted", "expected share of datagrams lost by a random draw"),
}
_BY_KEY = {
    "datagrams": ("fates", "fate", "datagrams by their fate"),
    "unintended_losses": ("unintended", "cause", "losses that no setting caused"),
}
_TIMES = {
    "delay_seconds": ("delay_ns", "time in the emulator, quantiles since its start"),
    "lateness_seconds": ("lateness_ns", "lateness of the emulator, quantiles since its start"),
}
_QUANTILES = {"p50": "0.5", "p99": "0.99", "p999": "0.999", "max": "1"}
_Rows = Iterable[tuple[list[str], float | None]]
"""Values by their labels; None: not known."""


class EmulatorMetrics:
    """Computes the metrics of a relay when they are read."""

    def __init__(self, commands: CommandQueue) -> None:
        self._commands = commands
        self._latest: Statistics | None = None
        self._at_s = 0.0

    def collect(self) -> Iterator[Metric]:
        """Yield the metrics; none while the relay does not answer."""
        if self._latest is None or time.monotonic() - self._at_s > _FRESH_S:
            try:
                self._latest = statistics(self._commands.snapshot())
            except PeerError:
                return
            self._at_s = time.monotonic()
        yield from metrics(self._latest)


def metrics(report: Statistics) -> Iterator[Metric]:
    """Yield the metrics of a relay's statistics; ``docs/operations.md`` lists them."""
    links: Any = report["links"]
    sides: Any = [([link["name"], name], link[name]) for link in links for name in DIRECTIONS]
    # Of the emulator and its links.
    yield _gauge("elapsed_seconds", "time since the emulator started", [], [([], report["elapsed_s"])])
    yield _gauge(
        "clients", "clients of a link", ["link"], [([link["name"]], link["clients"]) for link in links]
    )
    for name, (key, text) in _OF_LINK.items():
        yield _counter(name, text, ["link"], [([link["name"]], link[key]) for link in links])
    # Of each direction.
    for name, (key, text) in _COUNTERS.items():
        yield _counter(name, text, _LABELS, [(labels, side[key]) for labels, side in sides])
    for name, (key, text) in _GAUGES.items():
        yield _gauge(name, text, _LABELS, [(labels, side[key]) for labels, side in sides])
    for name, (key, text) in _LOSSES.items():
        yield _gauge(name, text, _LABELS, [(labels, side["loss"][key]) for labels, side in sides])
    for name, (key, label, text) in _BY_KEY.items():
        yield _counter(
            name,
            text,
            [*_LABELS, label],
            [([*labels, value], count) for labels, side in sides for value, count in side[key].items()],
        )
    for name, (key, text) in _TIMES.items():
        yield _gauge(
            name,
            text,
            [*_LABELS, "quantile"],
            [
                ([*labels, label], None if side[key][p] is None else side[key][p] / NS_PER_S)
                for labels, side in sides
                for p, label in _QUANTILES.items()
            ],
        )


def _counter(name: str, text: str, labels: Sequence[str], rows: _Rows) -> Metric:
    return _with_rows(CounterMetricFamily(f"{_PREFIX}_{name}", text, labels=labels), rows)


def _gauge(name: str, text: str, labels: Sequence[str], rows: _Rows) -> Metric:
    return _with_rows(GaugeMetricFamily(f"{_PREFIX}_{name}", text, labels=labels), rows)


def _with_rows(metric: CounterMetricFamily | GaugeMetricFamily, rows: _Rows) -> Metric:
    for values, value in rows:
        if value is not None:
            metric.add_metric(values, value)
    return metric
