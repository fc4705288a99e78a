"""An emulator's statistics as metrics of OpenMetrics; the names begin with ``noack_netem_``.

A module of its own: prometheus_client is an optional package.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from prometheus_client import Metric
from prometheus_client.metrics_core import (
    CounterMetricFamily,
    GaugeMetricFamily,
)

from netem.control.emulator_statistics import (
    CommandQueue,
    DirectionStatistics,
    Statistics,
    statistics,
)
from netem.relay_links import (
    DIRECTIONS,
)
from noack.core.clock import NS_PER_S
from noack.core.errors import PeerError

_PREFIX = "noack_netem"
_FRESH_S = 0.1
"""Newer statistics answer a further request, so that frequent readers do not load the relay."""

_COUNTERS: Mapping[str, tuple[Callable[[DirectionStatistics], int], str]] = {
    "received_datagrams": (lambda one: one["received"], "datagrams received"),
    "received_bytes": (lambda one: one["received_bytes"], "bytes received, payload only"),
    "forwarded_datagrams": (lambda one: one["forwarded"], "datagrams forwarded, copies included"),
    "forwarded_bytes": (lambda one: one["forwarded_bytes"], "bytes forwarded, payload only"),
    "duplicated_datagrams": (lambda one: one["duplicated"], "copies made"),
    "stale_datagrams": (lambda one: one["delivered_out_of_order"],
                        "datagrams delivered out of order"),
    "held_back_datagrams": (lambda one: one["held_back"],
                            "datagrams held back for the guarantee"),
}  # fmt: skip
_GAUGES: Mapping[str, tuple[Callable[[DirectionStatistics], float | None], str]] = {
    "in_flight_datagrams": (lambda one: one["in_flight"], "datagrams inside the emulator"),
    "longest_loss_burst": (lambda one: one["longest_loss_burst"],
                           "most consecutive losses of a flow under the present settings"),
    "loss_burst_limit": (lambda one: one["mansd"],
                         "most consecutive losses that the guarantee allows (M - 1)"),
    "loss_ratio": (lambda one: one["loss"]["realised"],
                   "share of the datagrams not effectively delivered, present settings"),
    "predicted_loss_ratio": (lambda one: one["loss"]["predicted"],
                             "expected share of datagrams lost by a random draw"),
}  # fmt: skip
_TIMES = {
    "delay_seconds": ("delay_ns", "time in the emulator, quantiles since its start"),
    "lateness_seconds": ("lateness_ns", "lateness of the emulator, quantiles since its start"),
}
_QUANTILES = {"p50": "0.5", "p99": "0.99", "p999": "0.999", "max": "1"}
_OF_LINK = {
    "refused_datagrams": ("refused", "datagrams of clients beyond the limit"),
    "discarded_datagrams": ("discarded", "datagrams that no client waits for"),
    "port_unreachable": ("port_unreachable", "answers that no process listens"),
}


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


def metrics(found: Statistics) -> Iterator[Metric]:
    """Yield the metrics of a relay's statistics; ``docs/operations.md`` lists them."""
    yield GaugeMetricFamily(
        f"{_PREFIX}_elapsed_seconds", "time since the emulator started", found["elapsed_s"]
    )
    clients = GaugeMetricFamily(f"{_PREFIX}_clients", "clients of a link", labels=["link"])
    for link in found["links"]:
        clients.add_metric([link["name"]], link["clients"])
    yield clients
    for name, (key, text) in _OF_LINK.items():
        counter = CounterMetricFamily(f"{_PREFIX}_{name}", text, labels=["link"])
        for link in found["links"]:
            counter.add_metric([link["name"]], link[key])  # type: ignore[literal-required]
        yield counter
    directions = [
        ([link["name"], name], link[name]) for link in found["links"] for name in DIRECTIONS
    ]
    yield from _of_directions(directions)


def _of_directions(directions: list[tuple[list[str], DirectionStatistics]]) -> Iterator[Metric]:
    labels = ["link", "direction"]
    for name, (count, text) in _COUNTERS.items():
        counter = CounterMetricFamily(f"{_PREFIX}_{name}", text, labels=labels)
        for values, one in directions:
            counter.add_metric(values, count(one))
        yield counter
    for name, (value, text) in _GAUGES.items():
        gauge = GaugeMetricFamily(f"{_PREFIX}_{name}", text, labels=labels)
        for values, one in directions:
            if (known := value(one)) is not None:
                gauge.add_metric(values, known)
        yield gauge
    yield from _by_key(directions, "fates", "datagrams", "fate", "datagrams by their fate")
    yield from _by_key(
        directions, "unintended", "unintended_losses", "cause", "losses that no setting caused"
    )
    for name, (key, text) in _TIMES.items():
        gauge = GaugeMetricFamily(f"{_PREFIX}_{name}", text, labels=[*labels, "quantile"])
        for values, one in directions:
            times: Any = one[key]  # type: ignore[literal-required]
            for quantile, label in _QUANTILES.items():
                if times[quantile] is not None:
                    gauge.add_metric([*values, label], times[quantile] / NS_PER_S)
        yield gauge


def _by_key(
    directions: list[tuple[list[str], DirectionStatistics]], key: str, name: str, label: str,
    text: str,
) -> Iterator[Metric]:  # fmt: skip
    counter = CounterMetricFamily(f"{_PREFIX}_{name}", text, labels=["link", "direction", label])
    for values, one in directions:
        counts: Mapping[str, int] = one[key]  # type: ignore[literal-required]
        for which, count in counts.items():
            counter.add_metric([*values, which], count)
    yield counter
