"""The summary of a run of several loops: the network that they share, and a line for each loop."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from cosim.analysis.run_summary import Outcome, change_parts
from cosim.analysis.summary_model import (
    ChangePart,
    Count,
    Counts,
    ExitPart,
    FlowPart,
    Real,
    ReplayPart,
    SummaryPart,
    Text,
    can_be_shown,
)
from cosim.record.run_record import Rows, RunRecord
from noack.config.loops import phases_ns
from noack.core.clock import NS_PER_S
from noack.core.errors import ExitStatus
from noack.impairments.feature import Impairment
from noack.impairments.kinds.duplicate import Duplicate
from noack.impairments.kinds.rate import Rate
from noack.protocol.record_tables import NETEM_PACKET, Fate, effective

_BINS = 200
_MOST_NAMED = 3


class LoopPart(SummaryPart):
    """A loop of the run; the summary of its own run directory has more."""

    name: Text
    number: Count
    phase_s: float
    exit: ExitPart
    events: Count
    deliveries: Count
    drops: Count
    drops_by_cause: Counts
    forced_deliveries: Count
    longest_loss_burst: Count
    link_share: Real
    """Share of the bytes that the network forwarded."""
    delay_mean_s: Real
    """Mean time of a forwarded datagram in the network."""
    delay_max_s: Real
    sup_e_c_norm: Real
    final_state_norm: Real
    diverged_at_s: Real
    claims: Counts
    """Number of claims by verdict."""
    void_because: list[Text] = Field(default_factory=list)
    """The reasons of its void claims, each once."""
    watchdog_trips: Count = 0
    """The number of times that the plant's watchdog acted."""
    actuations: FlowPart | None = None
    """None if they do not cross the network."""
    missing_samples: Count
    unintended_losses: Count
    bit_exact: bool | None
    """The result of the loop's replay; None for a simulated run, or if it was not possible."""


class InFlightPart(SummaryPart):
    """Datagrams inside the network: those that wait, are sent or are delayed."""

    mean: float
    """Over the time that the run reached."""
    max: Count
    width_s: float
    """Width of the intervals of the two lists."""
    mean_by_interval: list[float]
    max_by_interval: list[Count]


class NetworkPart(SummaryPart):
    """The network that all loops share, in the direction of the updates."""

    datagrams: Count
    forwarded: Count
    """Of these, some may still be in the network at the end of the run."""
    forced_deliveries: Count
    drops_by_cause: Counts
    longest_loss_burst: Count
    rate_bps: Count | None
    """The lowest rate of its bottlenecks; None without one."""
    utilisation: Real
    """Share of this rate that the datagrams used that left until the end of the run, with their
    overhead; with a duplication before the bottleneck, their copies, too."""
    in_flight: InFlightPart


class DeadlinesPart(SummaryPart):
    """The deadlines of a process, over all loops."""

    steps: Count
    late_steps: Count
    """Late by more than a period."""
    max_us: Real
    """Largest lateness, in wall µs."""


class LoopsSummary(SummaryPart):
    """The content of ``summary.json`` of a run of several loops."""

    kind: Literal["live", "simulated"]
    startup_s: Real
    scenario: Text
    mansd: Count
    constraints: list[str]
    horizon_s: float
    speed: float
    reached_s: float
    network: NetworkPart
    loops: Annotated[list[LoopPart], Field(min_length=1)]
    changes: list[ChangePart]
    """The changes of settings during the run, in the time of the run."""
    deadlines: dict[Text, DeadlinesPart] = Field(default_factory=dict)
    """By process; empty for a simulated run."""
    replay: ReplayPart | None = None
    """The replay of the network; those of the other processes are in the loops' summaries."""
    exit: ExitPart

    @model_validator(mode="after")
    def _numbers_are_in_turn(self) -> Self:
        if [one.number for one in self.loops] != [*range(len(self.loops))]:
            raise ValueError("the loops are numbered in turn")
        return self


def has_loops(summary: Mapping[str, Any]) -> bool:
    """Return whether a summary is that of a run of several loops."""
    return "loops" in summary


def is_complete(summary: Mapping[str, Any]) -> bool:
    """Return whether a file contains a complete summary of this version, of any kind of run."""
    if not has_loops(summary):
        return can_be_shown(summary)
    try:
        LoopsSummary.model_validate(summary)
    except ValidationError:
        return False
    return True


def summarise_loops(
    network: RunRecord, loops: Sequence[Outcome], end: ExitPart, startup_s: float | None = None
) -> LoopsSummary:
    """Return the summary of a run, from the record of its network and the outcomes of its loops.

    ``end`` is how the run ended; a run that completed has failed if one of its loops failed.
    """
    scenario = network.scenario
    packets = network[NETEM_PACKET]
    packets = packets[packets["flow"] < len(loops)]  # the others are acknowledgements
    forwarded_bytes = np.bincount(
        packets["flow"], np.where(packets["release_ns"] >= 0, packets["size_bytes"], 0), len(loops)
    )
    phases = phases_ns(scenario)
    reached_s = min(float(one.summary["reached_s"]) for one in loops)
    parts = [
        _loop_part(
            number, phases[number], one, packets[packets["flow"] == number],
            float(forwarded_bytes[number] / max(forwarded_bytes.sum(), 1)),
        )
        for number, one in enumerate(loops)
    ]  # fmt: skip
    return LoopsSummary(
        kind=network.kind,
        startup_s=startup_s,
        scenario=scenario.name,
        mansd=scenario.network.mansd,
        constraints=[one.text() for one in scenario.network.constraints],
        horizon_s=scenario.horizon_s,
        speed=scenario.speed,
        reached_s=reached_s,
        network=_network_part(network, packets, parts, reached_s),
        loops=parts,
        changes=change_parts(network),
        deadlines=_deadlines([one.summary["lateness_us"] for one in loops]),
        exit=end if end.status != ExitStatus.OK else _end(end, parts),
    )


def _deadlines(lateness_us: Sequence[Mapping[str, Any]]) -> dict[str, DeadlinesPart]:
    return {
        role: DeadlinesPart(
            steps=sum(one[role]["steps"] for one in lateness_us),
            late_steps=sum(one[role]["late_steps"] for one in lateness_us),
            max_us=max(
                (one[role]["max"] for one in lateness_us if one[role]["steps"]), default=None
            ),
        )
        for role in lateness_us[0]
    }


def _end(end: ExitPart, loops: Sequence[LoopPart]) -> ExitPart:
    failed = [one for one in loops if one.exit.status != ExitStatus.OK]
    if not failed:
        return end
    named = [f"{one.name} {_brief(one)}" for one in failed[:_MOST_NAMED]]
    more = len(failed) - len(named)
    shown = ", ".join(named) + (f" and {more} more" if more else "")
    reason = f"{len(failed)} of {len(loops)} loops failed ({shown})"
    return ExitPart(status=int(ExitStatus.FAILED), reason=reason)


def _brief(loop: LoopPart) -> str:
    if loop.diverged_at_s is not None:
        return f"diverged at {loop.diverged_at_s + loop.phase_s:.2f} s"
    return f"failed: {loop.exit.reason}"


def _loop_part(
    number: int, phase_ns: int, outcome: Outcome, packets: Rows, share: float
) -> LoopPart:
    summary = outcome.summary
    delays_s = _delays_ns(packets) / NS_PER_S
    same = (
        "events", "deliveries", "drops", "drops_by_cause", "forced_deliveries",
        "longest_loss_burst", "sup_e_c_norm", "final_state_norm", "diverged_at_s", "actuations",
        "missing_samples", "unintended_losses",
    )  # fmt: skip
    return LoopPart(
        name=Path(outcome.run_dir).name,
        number=number,
        phase_s=phase_ns / NS_PER_S,
        exit=ExitPart(status=int(outcome.status), reason=outcome.reason),
        link_share=share,
        delay_mean_s=float(delays_s.mean()) if len(delays_s) else None,
        delay_max_s=float(delays_s.max()) if len(delays_s) else None,
        claims=dict(Counter(str(claim["verdict"]) for claim in summary["claims"])),
        void_because=[
            *dict.fromkeys(c["why"] for c in summary["claims"] if c["verdict"] == "void")
        ],
        watchdog_trips=summary["watchdog"]["trips"],
        bit_exact=(summary["replay"] or {}).get("bit_exact"),
        **{key: summary[key] for key in same},
    )


def _network_part(
    network: RunRecord, packets: Rows, loops: Sequence[LoopPart], reached_s: float
) -> NetworkPart:
    fates, stages = packets["fate"], network.scenario.network.impairments
    rates = [one for one in stages if isinstance(one, Rate)]
    slowest = min(rates, key=lambda one: one.rate_bps, default=None)
    reached_ns = max(round(reached_s * NS_PER_S), 1)
    return NetworkPart(
        datagrams=len(packets),
        forwarded=int((packets["release_ns"] >= 0).sum()),
        forced_deliveries=int((fates == Fate.FORCED).sum()),
        drops_by_cause=dict(sum((Counter(one.drops_by_cause) for one in loops), Counter())),
        longest_loss_burst=max(one.longest_loss_burst for one in loops),
        rate_bps=None if slowest is None else slowest.rate_bps,
        utilisation=(
            None if slowest is None else _utilisation(packets, slowest, stages, reached_ns)
        ),
        in_flight=in_flight(packets, network.scenario.timing.horizon_ns, reached_ns),
    )


def _utilisation(
    packets: Rows, bottleneck: Rate, stages: Sequence[Impairment], until_ns: int
) -> float:
    """Return the share of a bottleneck's rate that was used until a time."""
    copied = any(isinstance(one, Duplicate) for one in stages[: stages.index(bottleneck)])
    left = [packets[name] for name in (("release_ns", "copy_ns") if copied else ("release_ns",))]
    times = sum(((at_ns >= 0) & (at_ns <= until_ns)).astype(np.int64) for at_ns in left)
    bits = (bottleneck.line_bits(packets["size_bytes"]) * times).sum()
    return float(bits / bottleneck.rate_bps / until_ns * NS_PER_S)


def _delays_ns(packets: Rows) -> NDArray[np.int64]:
    """The times of the effectively delivered datagrams in the network."""
    delivered = packets[effective(packets["fate"])]
    delays: NDArray[np.int64] = delivered["release_ns"] - delivered["now_ns"]
    return delays


def in_flight(packets: Rows, horizon_ns: int, reached_ns: int) -> InFlightPart:
    """Return how many datagrams were inside the network, in intervals of equal width."""
    inside = times_inside(packets)
    means, largest = counts_inside(*inside, np.linspace(0, horizon_ns, _BINS + 1))
    (mean,), _ = counts_inside(*inside, np.array([0.0, reached_ns]))
    return InFlightPart(
        mean=float(mean),
        max=int(largest.max()),
        width_s=horizon_ns / _BINS / NS_PER_S,
        mean_by_interval=means.round(6).tolist(),
        max_by_interval=largest.tolist(),
    )


def times_inside(packets: Rows) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return when each delayed datagram, or its copy, came into the network, and when it left."""
    begins, ends = [], []
    for column in ("release_ns", "copy_ns"):
        delayed = packets[packets[column] > packets["now_ns"]]
        begins.append(delayed["now_ns"])
        ends.append(delayed[column])
    return np.concatenate(begins), np.concatenate(ends)


def counts_inside(
    begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64], edges_ns: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return mean and largest number of datagrams in the network between the edges, (k + 1,)."""
    begin_ns, end_ns = np.sort(begin_ns), np.sort(end_ns)
    # The number of datagrams at t is the number of begins minus the number of ends up to t; its
    # integral from 0 to t is the sum of the times since each begin, minus that since each end.
    integral = _time_since(begin_ns, edges_ns) - _time_since(end_ns, edges_ns)
    first_ns, last_ns = (edges_ns[place].astype(np.int64) for place in (slice(-1), -1))
    new_ns = begin_ns[(begin_ns > first_ns[0]) & (begin_ns < last_ns)]
    at_ns = np.unique(np.concatenate([new_ns, first_ns]))
    counts = np.searchsorted(begin_ns, at_ns, "right") - np.searchsorted(end_ns, at_ns, "right")
    largest = np.maximum.reduceat(counts, np.searchsorted(at_ns, first_ns))
    return np.diff(integral) / np.diff(edges_ns), largest


def _time_since(moments_ns: NDArray[np.int64], at_ns: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum over the moments before each time of the time since then."""
    before = np.searchsorted(moments_ns, at_ns, "right")
    sums = np.append(0.0, np.cumsum(moments_ns, dtype=np.float64))
    return np.asarray(before * at_ns - sums[before])
