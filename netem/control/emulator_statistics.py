"""Statistics of a relay as a document of JSON: its keys, and how it is made of reports.

Keys are only ever added. Counts are since the relay began; ``recent`` is since the document before.
"""

from datetime import UTC, datetime
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from netem.control.command_queue import AppliedSettings, Snapshot
from netem.engine.histogram import coarse, quantile_ns
from netem.engine.relay_interface import Direction, DirectionReport, FlowReport, LinkReport
from noack.core.clock import NS_PER_S
from noack.impairments.link_records import Counters
from noack.protocol.record_tables import Fate
from noack.runtime.address import text_of

_WORDS_SHOWN = 200


class DelayQuantiles(TypedDict):
    """Of a time, in ns; null if there is none to speak of."""

    p50: int | None
    p99: int | None
    p999: int | None
    max: int | None


class LossStatistics(TypedDict):
    """Share of the datagrams that are not effectively delivered; null if not known."""

    realised: float | None
    """Since the settings came into force that the direction has now."""
    lost: float | None
    """Of that, what no intact copy leaves of; the rest leaves, but is overtaken."""
    drawn: float | None
    """Of that, what the settings drew to be dropped or corrupted; the rest came to a full queue or
    in a blackout."""
    predicted: float | None
    """What is drawn in the long run; see :mod:`netem.loss_prediction`."""


class RecentRates(TypedDict):
    """What has happened since the document before."""

    seconds: float
    arrived_per_s: float
    arrived_bits_per_s: float
    """Of payload."""
    forwarded_per_s: float
    forwarded_bits_per_s: float
    loss: float | None
    """Share of what has arrived that is not effectively delivered."""
    delay_ns: DelayQuantiles
    lateness_ns: DelayQuantiles


class FlowStatistics(TypedDict):
    """One flow of a direction."""

    flow: int
    client: str
    packets: int
    longest_loss_burst: int


class DirectionStatistics(TypedDict):
    """One direction of a link."""

    words: str
    """Its settings in the words of ``tc netem``; long tables are cut."""
    arrived_before: int
    """Datagrams that had come when these settings were applied; ``loss`` and
    ``longest_loss_burst`` count from there."""
    arrived: int
    arrived_bytes: int
    forwarded: int
    """Datagrams and copies that have left."""
    forwarded_bytes: int
    fates: dict[str, int]
    """How many datagrams had each fate: ``delivered``, ``dropped`` by a loss model, ``forced`` by
    the cap, ``corrupted``, ``overflowed``, ``blacked_out``."""
    duplicated: int
    delivered_out_of_order: int
    """Left after a newer one of their flow: stale at the receiver."""
    held_back: int
    """Not let overtake, as that would have broken the guarantee."""
    longest_loss_burst: int
    """Most successive datagrams of a flow that were not effectively delivered, of those that came
    since the settings are in force."""
    mansd: int | None
    """The cap on that; null if there is none."""
    loss: LossStatistics
    unintended: dict[str, int]
    """Unintended losses, by cause; any breaks the guarantee."""
    in_flight: int
    """Datagrams that are delayed, or queue for a bottleneck, now."""
    most_in_flight: int
    flows: list[FlowStatistics]
    """Those that sent most of the clients that are there now, at most 16."""
    delay_ns: DelayQuantiles
    """From arrival to departure."""
    lateness_ns: DelayQuantiles
    """From when a delayed datagram should have left until it did."""
    delay_histogram: list[list[int]]
    """Of each step that is not empty: its shortest time, in ns, and how many there are."""
    lateness_histogram: list[list[int]]
    recent: RecentRates | None
    """Null in the first document."""


class LinkStatistics(TypedDict):
    """One link."""

    name: str
    listen: str
    to: str
    clients: int
    clients_ever: int
    refused: int
    """Datagrams of more clients than are served."""
    discarded: int
    """Answers to a link that takes none; 0 if the system does not count them."""
    port_unreachable: int
    """How often ICMP said that nobody listens where the server should be; at least so often did a
    datagram come to nobody."""
    forward: DirectionStatistics
    back: DirectionStatistics


class Statistics(TypedDict):
    """A relay."""

    time: str
    """Wall time, UTC, as in ISO 8601."""
    elapsed_s: float
    """Since the relay began."""
    engine: str
    links: list[LinkStatistics]


def statistics(after: Snapshot, before: Snapshot | None = None) -> Statistics:
    """Return the statistics of a relay.

    Args:
        after: what has happened.
        before: an earlier snapshot of the same relay, for what is recent.
    """
    earlier = {link.name: link for link in before.links} if before is not None else {}
    seconds = (after.elapsed_ns - before.elapsed_ns) / NS_PER_S if before is not None else 0.0
    return {
        "time": datetime.fromtimestamp(after.unix_ns / NS_PER_S, UTC).isoformat(),
        "elapsed_s": after.elapsed_ns / NS_PER_S,
        "engine": after.engine,
        "links": [
            _link(link, earlier.get(link.name), seconds, after) for link in after.links
        ],
    }  # fmt: skip


def _link(
    after: LinkReport, before: LinkReport | None, seconds: float, snapshot: Snapshot
) -> LinkStatistics:
    def direction(
        name: Direction, report: DirectionReport, old: DirectionReport | None
    ) -> DirectionStatistics:
        key = (after.name, name)
        return _direction(report, snapshot.in_force[key], old, seconds)

    return {
        "name": after.name,
        "listen": text_of(after.listen),
        "to": text_of(after.to),
        "clients": after.clients,
        "clients_ever": after.clients_ever,
        "refused": after.refused,
        "discarded": after.discarded,
        "port_unreachable": after.port_unreachable,
        "forward": direction("forward", after.forward, before.forward if before else None),
        "back": direction("back", after.back, before.back if before else None),
    }


def _direction(
    report: DirectionReport,
    in_force: AppliedSettings,
    before: DirectionReport | None,
    seconds: float,
) -> DirectionStatistics:
    counters, since, words = report.counters, in_force.since, in_force.words
    return {
        "words": words if len(words) <= _WORDS_SHOWN else words[: _WORDS_SHOWN - 1] + "…",
        "arrived_before": since.arrived,
        "arrived": counters.arrived,
        "arrived_bytes": counters.arrived_bytes,
        "forwarded": counters.forwarded,
        "forwarded_bytes": counters.forwarded_bytes,
        "fates": {fate.name.lower(): getattr(counters, fate.name.lower()) for fate in Fate},
        "duplicated": counters.duplicated,
        "delivered_out_of_order": counters.delivered_out_of_order,
        "held_back": counters.held_back,
        "longest_loss_burst": counters.longest_loss_burst,
        "mansd": report.settings.mansd,
        "loss": {
            "realised": loss_share(counters, since),
            "lost": _share(counters, since, "dropped", "corrupted", "overflowed", "blacked_out"),
            "drawn": _share(counters, since, "dropped", "corrupted"),
            "predicted": in_force.predicted_loss,
        },
        "unintended": dict(report.unintended),
        "in_flight": report.in_flight,
        "most_in_flight": counters.most_in_flight,
        "flows": [_flow(flow) for flow in report.flows],
        "delay_ns": quantiles(report.delays),
        "lateness_ns": quantiles(report.lateness),
        "delay_histogram": coarse(report.delays),
        "lateness_histogram": coarse(report.lateness),
        "recent": _recent(report, before, seconds) if before is not None and seconds > 0 else None,
    }


def _recent(after: DirectionReport, before: DirectionReport, seconds: float) -> RecentRates:
    new, old = after.counters, before.counters
    return {
        "seconds": seconds,
        "arrived_per_s": (new.arrived - old.arrived) / seconds,
        "arrived_bits_per_s": (new.arrived_bytes - old.arrived_bytes) * 8 / seconds,
        "forwarded_per_s": (new.forwarded - old.forwarded) / seconds,
        "forwarded_bits_per_s": (new.forwarded_bytes - old.forwarded_bytes) * 8 / seconds,
        "loss": loss_share(new, old),
        "delay_ns": quantiles(after.delays - before.delays),
        "lateness_ns": quantiles(after.lateness - before.lateness),
    }


def unintended(totals: Statistics) -> int:
    """Return how many datagrams were lost unintentionally in all links."""
    directions = [link[side] for link in totals["links"] for side in ("forward", "back")]
    return sum(sum(direction["unintended"].values()) for direction in directions)


def loss_share(after: Counters, before: Counters) -> float | None:
    """Return the share of what came between that was not effectively delivered; None if nothing.

    What was overtaken is not effectively delivered. It shows when it leaves, so that in a short
    time more may be lost than came: the share is at most 1.
    """
    arrived = after.arrived - before.arrived
    if arrived == 0:
        return None
    lost = arrived - _effective(after) + _effective(before)
    return min(max(lost, 0) / arrived, 1.0)


def _effective(counters: Counters) -> int:
    return counters.delivered + counters.forced - counters.delivered_out_of_order


def _share(after: Counters, before: Counters, *fates: str) -> float | None:
    """Return the share of what came between that had one of some fates; None if nothing came."""
    arrived = after.arrived - before.arrived
    if arrived == 0:
        return None
    lost: int = sum(getattr(after, fate) - getattr(before, fate) for fate in fates)
    return lost / arrived


def quantiles(counts: NDArray[np.int64]) -> DelayQuantiles:
    """Return quantiles of a histogram of :mod:`netem.engine.histogram`."""
    if not counts.any():
        return {"p50": None, "p99": None, "p999": None, "max": None}
    return {
        "p50": round(quantile_ns(counts, 0.5)),
        "p99": round(quantile_ns(counts, 0.99)),
        "p999": round(quantile_ns(counts, 0.999)),
        "max": round(quantile_ns(counts, 1.0)),
    }


def _flow(flow: FlowReport) -> FlowStatistics:
    return {
        "flow": flow.flow,
        "client": text_of(flow.client),
        "packets": flow.packets,
        "longest_loss_burst": flow.longest_loss_burst,
    }
