"""From a scenario to the loop that a document without motions is about, and what is proven of it."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from netem.core.errors import CallerError
from netem.guarantee.loss_guarantee import LossGuarantee
from noack.proof.forms_proof import FORMAT, as_text
from noack.proof.period_document import PeriodDocument, PeriodLoop, PeriodOutput
from noack.proof.period_graph import PeriodGraph
from noack.proof.period_times import ArrivalAtTransmissionError
from noack.scenario.arrival_ties import LATENCY_NS
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.time_triggered.scenario_times import loop_times, steady_reference
from noack.theory.witnesses.period_growth import GrowthSearch
from noack_kernel import GrowthStatement, RejectedError, prove

Entry = dict[str, Any]
_ROUNDED = 1e-12
"""A rate at the set-point that is a smaller share of its terms is 0, but for rounding."""
_GAPS = 3.0
"""Factor by which the gap between both bounds of a growth becomes larger after a proof that failed."""
_LARGEST_GAP = 0.3
_ONLY_CYCLE = 1e-6
"""The gap of a document in which there is no choice: forms exist for every growth above its own."""
_BELOW = (1e-10, 1e-6)
"""By so much less than the growth of a cycle, relatively, a proof claims; the first that is accepted."""
_SHARE = 0.1
"""A growth below 1 by this share of its distance from the lower bound is proven."""


def period_loop(resolved: Scenario, between: range, unit: int) -> PeriodLoop:
    """Return the loop of a scenario.

    Args:
        resolved: the resolved scenario.
        between: numbers of units that may be between two transmissions.
        unit: in measurements.

    Raises:
        CallerError: the loop is not covered; the message names the setting.
    """
    loop, times = loop_of(resolved), loop_times(resolved, unit)
    try:
        for slot in range(times.slots):
            times.arrivals(slot)
    except ArrivalAtTransmissionError:
        raise CallerError(
            "network.impairments.delay_s: not covered if an update arrives within "
            f"{LATENCY_NS / 1e6:g} ms of a transmission and of a tick; change controller.phase"
        ) from None
    followed, rate = steady_reference(resolved) or (np.zeros(loop.n + loop.m),) * 2
    x_r, u_r = followed[: loop.n], followed[loop.n :]
    push = loop.A @ x_r + loop.B @ u_r - rate[: loop.n]
    terms = np.abs(loop.A) @ np.abs(x_r) + np.abs(loop.B) @ np.abs(u_r)
    safe = resolved.controller.safe_input
    states = [*loop.state_names, *(f"x{i}" for i in range(len(loop.state_names), loop.n))]
    inputs = [*loop.input_names, *(f"u{i}" for i in range(len(loop.input_names), loop.m))]
    return PeriodLoop(
        name=resolved.name,
        A=loop.A,
        B=loop.B,
        K=loop.K,
        H=loop.H,
        times=times,
        start=loop.x0 - x_r,
        input_before=-u_r,
        safe_input=-u_r if safe is None else np.array(safe) - u_r,
        push=np.where(np.abs(push) <= _ROUNDED * terms, 0.0, push),
        states=_unique(states),
        inputs=_unique(inputs, states),
        state_units=resolved.model.state_units or (),
        outputs=[PeriodOutput(output.name, output.unit, np.array(output.row)) for output in loop.outputs],
        late=resolved.certificate.late_periods,
        knows_start=resolved.network.initial_sync == "known_state",
        between=between,
    )


def _unique(names: Sequence[str], others: Sequence[str] = ()) -> list[str]:
    """Return names of which none occurs twice, or among others."""
    found: list[str] = []
    for name in names:
        unique, number = name, 2
        while unique in (*found, *others, "f1", "f2"):
            unique, number = f"{name} ({number})", number + 1
        found.append(unique)
    return found


class ProvenGrowth(NamedTuple):
    """Bounds of the growth per unit of a loop under a guarantee, which the kernel has proven."""

    lower: float
    """0: no cycle was found that grows."""
    upper: float
    """Infinity: none was proven."""
    outcomes: tuple[tuple[bool, int, int], ...]
    """Of the cycle's edges: whether an update is delivered, the slot, and the units until the next one."""
    most: Entry | None = None
    """The entry of a proof of the upper bound."""
    least: Entry | None = None


def prove_growth(
    loop: PeriodLoop,
    guarantee: LossGuarantee,
    accuracy: float,
    *,
    decide: bool = True,
    effort: float = 1.0,
) -> ProvenGrowth:
    """Bound the growth of all patterns that a guarantee allows.

    Args:
        loop: the loop.
        guarantee: the outcomes that are allowed.
        accuracy: wanted upper/lower − 1 per unit.
        decide: whether bounds on both sides of 1 are improved.
        effort: factor of the products of paths that are considered.

    Raises:
        NoDocumentError: the document would be too large.
        OverflowError: the loop grows too much between two transmissions.
    """
    document = PeriodDocument(loop, guarantee)
    graph = PeriodGraph(document.table)
    search, text = GrowthSearch(graph), as_text(document.table)
    found = ProvenGrowth(0.0, np.inf, ())
    cycle, lower = search.cycle, 0.0
    if cycle is not None:
        lower, period = cycle.growth, loop.times.exact_seconds(loop.times.period)
        outcomes = tuple((*document.outcomes[edge.name], int(edge.duration / period)) for edge in cycle.edges)
        for below in _BELOW:
            least = search.at_least(cycle, below)
            if least is not None and (proven := _accepted(text, least)) is not None:
                found = found._replace(lower=float(proven.factor), outcomes=outcomes, least=least)
                break
    if search.is_only_cycle:
        accuracy = min(accuracy, _ONLY_CYCLE)
    gap, limit = accuracy, 1 - _SHARE * (1 - lower) if decide and lower < 1 else np.inf
    while gap < _LARGEST_GAP:
        growth = max(lower, 1e-9) * (1 + gap)
        if growth >= limit:
            growth, gap = limit, np.inf
        most = search.at_most(growth, effort)
        if most is not None and (proven := _accepted(text, most)) is not None:
            return found._replace(upper=float(proven.factor), most=most)
        if limit < np.inf and gap == np.inf:
            limit, gap = np.inf, growth / max(lower, 1e-9) - 1
        gap *= _GAPS
    return found


def _accepted(document: str, entry: Entry) -> GrowthStatement | None:
    """Return what the kernel proves; None: it rejects the entry."""
    try:
        proof = as_text({"format": FORMAT, "bounds": [], "growth": [entry]})
        (statement,) = prove(document, proof).growth
    except RejectedError:
        return None
    return statement
