"""A relay's statistics as a JSON document.

:func:`statistics` makes the document of two snapshots. Later versions may add keys, but remove
none. Counts are totals since the relay started; ``recent`` covers the time since the previous
document. :class:`StatisticsThread` takes snapshots at intervals, and passes documents to a consumer.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Self, TypedDict

import numpy as np
from numpy.typing import NDArray

from netem.control.command_queue import AppliedSettings, CommandQueue, Snapshot
from netem.core.address import address_text
from netem.core.clock import NS_PER_S
from netem.core.errors import PeerError
from netem.core.packet_rows import Fate
from netem.impairments.link_settings import Counters
from netem.relay.relay_reports import (
    DIRECTIONS,
    Direction,
    DirectionReport,
    LinkReport,
    coarse_histogram,
    quantile_ns,
)

_Z = 1.959963984540054
"""Quantile of the normal distribution for a 95 % interval."""
_MAX_WORDS = 200
"""Longer settings are cut to this number of characters."""


class DelayQuantiles(TypedDict):
    """Quantiles of a time in ns; null if nothing was measured."""

    p50: int | None
    p99: int | None
    p999: int | None
    max: int | None


class LossStatistics(TypedDict):
    """Shares of the datagrams received under the present settings; null if unknown."""

    realised: float | None
    """Share not effectively delivered: lost, or delivered out of order (stale)."""
    lost: float | None
    """Share without an intact forwarded copy."""
    drawn: float | None
    """Share dropped or corrupted by a random draw, not by a full queue or a blackout."""
    drawn_interval: list[float] | None
    """95 % interval of the rate that ``drawn`` measures, by the predicted correlation of the losses."""
    predicted: float | None
    """Expected value of ``drawn``; see :mod:`netem.impairments.loss_prediction`."""


class RecentRates(TypedDict):
    """Rates since the previous document."""

    seconds: float
    received_per_s: float
    received_bits_per_s: float
    """Payload only."""
    forwarded_per_s: float
    forwarded_bits_per_s: float
    loss: float | None
    """Share of the received datagrams that was not effectively delivered."""
    delay_ns: DelayQuantiles
    lateness_ns: DelayQuantiles


class FlowStatistics(TypedDict):
    """One flow of a direction."""

    flow: int
    client: str
    packets: int
    longest_loss_burst: int


class DirectionStatistics(TypedDict):
    """One direction of a link; see :class:`netem.relay.relay_reports.DirectionReport`.

    The counts are those of :class:`netem.impairments.link_settings.Counters`.
    """

    words: str
    """Its settings in the words of ``tc netem``; long tables are cut."""
    received_before: int
    """Datagrams received before these settings applied; ``loss`` and ``longest_loss_burst``
    count from there."""
    received: int
    received_bytes: int
    forwarded: int
    forwarded_bytes: int
    fates: dict[str, int]
    """Datagrams by fate: ``delivered``, ``dropped`` by a loss model, ``forced`` by the cap,
    ``corrupted``, ``overflowed``, ``blacked_out``."""
    duplicated: int
    delivered_out_of_order: int
    held_back: int
    longest_loss_burst: int
    mansd: int | None
    """Maximum of that number that the guarantee allows; null if there is none."""
    constraints: list[str]
    """The further constraints of the guarantee, in words."""
    loss: LossStatistics
    unintended: dict[str, int]
    in_flight: int
    most_in_flight: int
    flows: list[FlowStatistics]
    delay_ns: DelayQuantiles
    lateness_ns: DelayQuantiles
    delay_histogram: list[list[int]]
    """Lower limit in ns and count of each bin that is not empty."""
    lateness_histogram: list[list[int]]
    recent: RecentRates | None
    """Null in the first document."""


class LinkStatistics(TypedDict):
    """One link; see :class:`netem.relay.relay_reports.LinkReport`."""

    name: str
    listen: str
    to: str
    clients: int
    clients_ever: int
    refused: int
    discarded: int
    port_unreachable: int
    forward: DirectionStatistics
    reverse: DirectionStatistics


class Statistics(TypedDict):
    """A relay."""

    time: str
    """Wall time, UTC, ISO 8601."""
    elapsed_s: float
    """Time since the relay started."""
    links: list[LinkStatistics]


def statistics(latest: Snapshot, earlier: Snapshot | None = None) -> Statistics:
    """Return the statistics of a relay; the recent rates need an earlier snapshot."""
    earlier_links = {link.name: link for link in earlier.links} if earlier is not None else {}
    seconds = (latest.elapsed_ns - earlier.elapsed_ns) / NS_PER_S if earlier is not None else 0.0
    links = [_link(link, earlier_links.get(link.name), seconds, latest) for link in latest.links]
    return {
        "time": datetime.fromtimestamp(latest.unix_ns / NS_PER_S, UTC).isoformat(),
        "elapsed_s": latest.elapsed_ns / NS_PER_S,
        "links": links,
    }


def _link(new: LinkReport, old: LinkReport | None, seconds: float, snapshot: Snapshot) -> LinkStatistics:
    def direction(name: Direction) -> DirectionStatistics:
        applied = snapshot.applied[new.name, name]
        return _direction(getattr(new, name), applied, getattr(old, name, None), seconds)

    return {
        "name": new.name,
        "listen": address_text(new.listen),
        "to": address_text(new.to),
        "clients": new.clients,
        "clients_ever": new.clients_ever,
        "refused": new.refused,
        "discarded": new.discarded,
        "port_unreachable": new.port_unreachable,
        "forward": direction("forward"),
        "reverse": direction("reverse"),
    }


def _direction(
    report: DirectionReport,
    applied: AppliedSettings,
    earlier: DirectionReport | None,
    seconds: float,
) -> DirectionStatistics:
    counters, since, words = report.counters, applied.since, applied.words
    new = counters - since
    return {
        "words": words if len(words) <= _MAX_WORDS else words[: _MAX_WORDS - 1] + "…",
        "received_before": since.received,
        "received": counters.received,
        "received_bytes": counters.received_bytes,
        "forwarded": counters.forwarded,
        "forwarded_bytes": counters.forwarded_bytes,
        "fates": {fate.name.lower(): getattr(counters, fate.name.lower()) for fate in Fate},
        "duplicated": counters.duplicated,
        "delivered_out_of_order": counters.delivered_out_of_order,
        "held_back": counters.held_back,
        "longest_loss_burst": counters.longest_loss_burst,
        "mansd": report.settings.longest_burst,
        "constraints": [constraint.text() for constraint in report.settings.constraints],
        "loss": {
            "realised": loss_share(new),
            "lost": _share(new, new.dropped + new.corrupted + new.overflowed + new.blacked_out),
            "drawn": _share(new, new.dropped + new.corrupted),
            "drawn_interval": rate_interval(
                new.dropped + new.corrupted, new.received, applied.loss_variance, applied.predicted_loss
            ),
            "predicted": applied.predicted_loss,
        },
        "unintended": dict(report.unintended),
        "in_flight": report.in_flight,
        "most_in_flight": counters.most_in_flight,
        "flows": [
            FlowStatistics(flow=flow, client=client, packets=n, longest_loss_burst=burst)
            for flow, client, n, burst in report.flows
        ],
        "delay_ns": quantiles(report.delays),
        "lateness_ns": quantiles(report.lateness),
        "delay_histogram": coarse_histogram(report.delays),
        "lateness_histogram": coarse_histogram(report.lateness),
        "recent": _recent(report, earlier, seconds) if earlier is not None and seconds > 0 else None,
    }


def _recent(latest: DirectionReport, earlier: DirectionReport, seconds: float) -> RecentRates:
    new = latest.counters - earlier.counters
    return {
        "seconds": seconds,
        "received_per_s": new.received / seconds,
        "received_bits_per_s": new.received_bytes * 8 / seconds,
        "forwarded_per_s": new.forwarded / seconds,
        "forwarded_bits_per_s": new.forwarded_bytes * 8 / seconds,
        "loss": loss_share(new),
        "delay_ns": quantiles(latest.delays - earlier.delays),
        "lateness_ns": quantiles(latest.lateness - earlier.lateness),
    }


def unintended_losses(totals: Statistics) -> int:
    """Return the number of unintended losses of all links."""
    directions = [link[name] for link in totals["links"] for name in DIRECTIONS]
    return sum(sum(direction["unintended"].values()) for direction in directions)


def loss_share(counters: Counters) -> float | None:
    """Return the share of the received datagrams that was not effectively delivered.

    None if no datagram was received. A stale datagram counts when it is forwarded; in a short
    interval, more datagrams may therefore be lost than received. The share is limited to 1.
    """
    effective = counters.delivered + counters.forced - counters.delivered_out_of_order
    return _share(counters, min(max(counters.received - effective, 0), counters.received))


def rate_interval(
    lost: int, packets: int, variance: float | None, predicted: float | None
) -> list[float] | None:
    """Return the 95 % interval of a loss rate (Wilson, 1927); None without packets.

    Args:
        lost: lost packets.
        packets: packets.
        variance: of the number of losses among n packets, divided by n; None: as independent losses.
        predicted: the loss rate to which it belongs.
    """
    if not packets:
        return None
    count, share = float(packets), lost / packets
    if variance and predicted and 0 < predicted < 1:
        count *= predicted * (1 - predicted) / variance  # so many independent packets say as much
    middle = (share + _Z**2 / (2 * count)) / (1 + _Z**2 / count)
    half = _Z / (1 + _Z**2 / count) * math.sqrt(share * (1 - share) / count + _Z**2 / (4 * count**2))
    return [max(middle - half, 0.0), min(middle + half, 1.0)]


def _share(counters: Counters, lost: int) -> float | None:
    return lost / counters.received if counters.received else None


def quantiles(counts: NDArray[np.int64]) -> DelayQuantiles:
    """Return quantiles of a histogram of times."""
    if not counts.any():
        return {"p50": None, "p99": None, "p999": None, "max": None}
    p50, p99, p999, largest = (round(quantile_ns(counts, q)) for q in (0.5, 0.99, 0.999, 1.0))
    return {"p50": p50, "p99": p99, "p999": p999, "max": largest}


_JOIN_S = 10.0
"""Longest wait for the end of the thread."""


class StatisticsThread:
    """Takes a snapshot at once and then every ``period_s``, within the context.

    Args:
        commands: give access to the relay.
        period_s: time between two snapshots.
        show: is called with the statistics of each; None: they are only for :meth:`current`.
        at_end: also show the final statistics at the end of the context; the relay must have ended
            by then.
    """

    def __init__(
        self,
        commands: CommandQueue,
        period_s: float,
        show: Callable[[Statistics], None] | None = None,
        *,
        at_end: bool = False,
    ) -> None:
        self._commands = commands
        self._period_s = period_s
        self._show = show
        self._at_end = at_end
        self._snapshots: deque[Snapshot] = deque(maxlen=2)
        self._predicting = threading.Lock()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="statistics", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join(_JOIN_S)

    def current(self) -> Statistics:
        """Return the present statistics, with rates over the last one or two periods.

        Raises:
            PeerError: the relay has ended, or does not answer.
        """
        earlier = self._snapshots[0] if self._snapshots else None
        latest = self._commands.snapshot()
        with self._predicting:  # a prediction may take seconds; several threads would each make it
            return statistics(latest, earlier)

    def _run(self) -> None:
        due_s = time.monotonic()
        while not self._stopping.wait(max(due_s - time.monotonic(), 0)):
            due_s = max(due_s + self._period_s, time.monotonic())
            with suppress(PeerError):
                self._take(self._commands.snapshot())
        if self._at_end:
            self._take(self._commands.snapshot_here())

    def _take(self, snapshot: Snapshot) -> None:
        earlier = self._snapshots[-1] if self._snapshots else None
        self._snapshots.append(snapshot)
        if self._show is not None:
            self._show(statistics(snapshot, earlier))
