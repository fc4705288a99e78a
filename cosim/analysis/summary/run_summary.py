"""The summary of a run: its network, the summaries of its loops, and which loop is the worst."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.analysis.summary.loop_summary import change_parts
from cosim.analysis.summary.summary_model import (
    Claim,
    DeadlinesPart,
    ExitPart,
    InFlightPart,
    LatenessPart,
    LoopSummary,
    NetworkPart,
    RunSummary,
)
from cosim.record.run_record import Rows, RunRecord, no_such_loop
from netem.core.clock import NS_PER_S
from netem.core.errors import ExitStatus
from netem.core.number_format import number as number_text
from netem.core.packet_rows import NETEM_PACKET, Fate
from netem.impairments.feature import Impairment
from netem.impairments.kinds.duplicate import Duplicate
from netem.impairments.kinds.rate import Rate

_BINS = 200
"""Intervals of the datagrams in flight."""
_MOST_NAMED = 3
"""Failed loops that are named in the reason."""
_COLUMNS = ("sequence", "now_ns", "flow", "fate", "release_ns", "copy_ns", "size_bytes")


@dataclass(frozen=True)
class Outcome:
    """The outcome of a run, for tables and programs."""

    run_dir: Path
    status: ExitStatus
    reason: str
    summary: RunSummary
    loop: str | None = None
    """Name of the loop, if this is the outcome of one loop of several."""


def outcome_of_loop(outcome: Outcome, loop: str | None) -> Outcome:
    """Return the outcome of a loop of a run; without a name, that of the run.

    Raises:
        CallerError: there is no such loop.
    """
    if loop is None:
        return outcome
    names = [each.name for each in outcome.summary.loops]
    if loop not in names:
        raise no_such_loop(loop, names)
    summary = outcome.summary.of_loop(loop)
    status = ExitStatus(summary.exit.status)
    return Outcome(outcome.run_dir, status, summary.exit.reason, summary, loop if len(names) > 1 else None)


def summarise_run(
    network: RunRecord,
    loops: Sequence[LoopSummary],
    end: ExitPart,
    startup_s: float | None = None,
) -> RunSummary:
    """Return the summary of a run, from the record of its network and the summaries of its loops.

    ``end`` is how the run ended; a run that completed has failed if one of its loops failed.
    ``startup_s`` is the wall time from the launch to simulated time 0; None if unknown.
    """
    scenario = network.scenario
    packets = network.columns(
        NETEM_PACKET, *_COLUMNS, where=lambda rows: rows["flow"] < len(loops)
    )  # the others are of the other direction
    packets = network.with_departures(packets)
    forwarded_bytes = np.bincount(
        packets["flow"], np.where(packets["release_ns"] >= 0, packets["size_bytes"], 0), len(loops)
    )
    shares = forwarded_bytes / max(forwarded_bytes.sum(), 1)
    reached_s = min(loop.reached_s for loop in loops)
    return RunSummary(
        kind=network.kind,
        startup_s=startup_s,
        scenario=scenario.name,
        mansd=scenario.network.mansd,
        constraints=[constraint.text() for constraint in scenario.network.constraints],
        horizon_s=scenario.horizon_s,
        speed=scenario.speed,
        reached_s=reached_s,
        network=_network_part(network, packets, loops, reached_s),
        loops=[
            loop.model_copy(update={"link_share": float(share)})
            for loop, share in zip(loops, shares, strict=True)
        ],
        changes=change_parts(network),
        deadlines=_deadlines([loop.lateness_us for loop in loops]),
        exit=end if end.status != ExitStatus.OK else _end(end, loops),
    )


def _deadlines(lateness_us: Sequence[Mapping[str, LatenessPart]]) -> dict[str, DeadlinesPart]:
    return {
        role: DeadlinesPart(
            steps=sum(late[role].steps for late in lateness_us),
            late_steps=sum(late[role].late_steps for late in lateness_us),
            max_us=max((late[role].max or 0.0 for late in lateness_us if late[role].steps), default=None),
        )
        for role in lateness_us[0]
    }


def _end(end: ExitPart, loops: Sequence[LoopSummary]) -> ExitPart:
    failed = [loop for loop in loops if loop.exit.status != ExitStatus.OK]
    if not failed:
        return end
    if len(loops) == 1:
        return loops[0].exit
    named = [f"{loop.name} {_brief(loop)}" for loop in failed[:_MOST_NAMED]]
    more = len(failed) - len(named)
    names = ", ".join(named) + (f" and {more} more" if more else "")
    reason = f"{len(failed)} of {len(loops)} loops failed ({names})"
    return ExitPart(status=int(ExitStatus.FAILED), reason=reason)


def _brief(loop: LoopSummary) -> str:
    if loop.diverged_at_s is not None:
        return f"diverged at {loop.diverged_at_s + loop.phase_s:.2f} s"
    return f"failed: {loop.exit.reason}"


def _network_part(
    network: RunRecord, packets: Rows, loops: Sequence[LoopSummary], reached_s: float
) -> NetworkPart:
    fates, stages = packets["fate"], network.scenario.network.impairments
    rates = [stage for stage in stages if isinstance(stage, Rate)]
    slowest = min(rates, key=lambda rate: rate.rate_bps, default=None)
    reached_ns = max(round(reached_s * NS_PER_S), 1)
    return NetworkPart(
        datagrams=len(packets),
        forwarded=int((packets["release_ns"] >= 0).sum()),
        forced_deliveries=int((fates == Fate.FORCED).sum()),
        drops_by_cause=dict(sum((Counter(loop.drops_by_cause) for loop in loops), Counter())),
        longest_loss_burst=max(loop.longest_loss_burst for loop in loops),
        rate_bps=None if slowest is None else slowest.rate_bps,
        utilisation=(None if slowest is None else _utilisation(packets, slowest, stages, reached_ns)),
        in_flight=in_flight(packets, network.scenario.timing.horizon_ns, reached_ns),
    )


def _utilisation(packets: Rows, bottleneck: Rate, stages: Sequence[Impairment], until_ns: int) -> float:
    """Return the share of a bottleneck's rate that was used until a time."""
    copied = any(isinstance(stage, Duplicate) for stage in stages[: stages.index(bottleneck)])
    departures = [packets[name] for name in (("release_ns", "copy_ns") if copied else ("release_ns",))]
    copies_sent = sum(((at_ns >= 0) & (at_ns <= until_ns)).astype(np.int64) for at_ns in departures)
    bits = (bottleneck.line_bits(packets["size_bytes"]) * copies_sent).sum()
    return float(bits / bottleneck.rate_bps / until_ns * NS_PER_S)


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
    in_ns: NDArray[np.int64] = packets["now_ns"]
    for column in ("release_ns", "copy_ns"):
        out_ns: NDArray[np.int64] = packets[column]
        is_delayed = out_ns > in_ns
        begins.append(in_ns[is_delayed])
        ends.append(out_ns[is_delayed])
    return np.concatenate(begins), np.concatenate(ends)


def counts_inside(
    begin_ns: NDArray[np.int64], end_ns: NDArray[np.int64], edges_ns: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return mean and largest number of datagrams in the network between the edges, (k + 1,)."""
    begin_ns, end_ns = np.sort(begin_ns), np.sort(end_ns)
    # The number of datagrams at t is the number of begins minus the number of ends up to t; its
    # integral from 0 to t is the sum of the times since each begin, minus that since each end.
    integral = _time_since(begin_ns, edges_ns) - _time_since(end_ns, edges_ns)
    first_ns, last_ns = (edges_ns[part].astype(np.int64) for part in (slice(-1), -1))
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


class WorstLoop(NamedTuple):
    """The loop that is shown in detail."""

    number: int
    why: str
    """What makes it the worst."""


def worst_loop(loops: Sequence[LoopSummary]) -> WorstLoop:
    """Return the worst loop of a run.

    That is a loop that failed; else the one that came nearest to, or exceeded, a certified bound of
    ‖e_c‖ or ‖x‖; without such bounds, the one with the largest ‖e_c‖.
    """
    for loop in loops:
        if loop.exit.status != ExitStatus.OK:
            return WorstLoop(loop.number, loop.exit.reason)
    used = [_share_used(loop.claims) for loop in loops]
    if max(used) > 0:
        number = int(np.argmax(used))
        text = f"largest share used of a certified bound of ‖e_c‖ or ‖x‖: {100 * used[number]:.3g} %"
        return WorstLoop(loops[number].number, text)
    errors = [-1.0 if loop.sup_e_c_norm is None else loop.sup_e_c_norm for loop in loops]
    number = int(np.argmax(errors))
    text = f"largest ‖e_c‖, {number_text(errors[number])}; no loop has a certified bound"
    return WorstLoop(loops[number].number, text)


def _share_used(claims: Sequence[Claim]) -> float:
    """Return the largest share of a certified bound that a loop reached; 0 without a bound."""
    return max(
        (
            claim.ratio
            for claim in claims
            if claim.is_certified and claim.quantity in ("e_c", "x") and claim.ratio is not None
        ),
        default=0.0,
    )
