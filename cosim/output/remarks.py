"""Remarks on a run that limit the validity of its numbers, one sentence each."""

from collections.abc import Iterator
from typing import NamedTuple

from cosim.analysis.claims.observed_conditions import CAUSES
from cosim.analysis.summary_model import FidelityPart, LoopSummary, RunSummary
from cosim.output.run_tables import away, changes_in
from noack.theory.certificates.assumptions import AssumptionStatus

_MOST = 5
_MOST_GROWTH, _MOST_LATE = 10.0, 0.01


class Remark(NamedTuple):
    """One sentence."""

    text: str
    severe: bool = False
    """Whether a guarantee was broken."""


def remarks(summary: RunSummary) -> Iterator[Remark]:
    """Yield the remarks on one loop, the severe ones first; none if all went well."""
    (loop,) = summary.loops
    violations = loop.assumption_violations
    for one in violations[:_MOST]:
        where = f"t = {one.t_s:.3f} s (reported by {one.process})"
        severe = one.cause not in CAUSES  # the guarantee, or a change
        yield Remark(f"assumption violated at {where}: {one.what}", severe=severe)
    if len(violations) > _MOST:
        yield Remark(f"{len(violations) - _MOST} more violations of this kind", severe=True)
    if loop.replay is not None and loop.replay.bit_exact is False:
        yield Remark("the replay of the run differs from its record", severe=True)
    yield from map(Remark, _warnings(summary, loop))


def has_clocks(loop: LoopSummary) -> bool:
    """Whether bounds of clocks' errors are recorded, as of a run on several hosts."""
    return loop.conditions is not None and loop.conditions.clock_error_s is not None


def _warnings(summary: RunSummary, loop: LoopSummary) -> Iterator[str]:
    for one in loop.assumptions:
        if one.verdict == AssumptionStatus.VIOLATED:
            yield f"assumption violated: {one.what} ({one.source}): {one.why}"
    late = loop.lateness_us.get("plant")
    if late and late.late_steps > _MOST_LATE * late.steps:
        share = 100 * late.late_steps / late.steps
        yield f"the plant missed {share:.0f} % of its deadlines: lower speed or plant.rate_hz"
    first, last = loop.initial_state_norm, loop.final_state_norm
    grew = first is not None and last is not None and last > _MOST_GROWTH * first > 0
    if grew and loop.diverged_at_s is None:  # else it is the reason why the run ended
        yield f"‖x‖ grew from {first:.3g} to {last:.3g} during the run"
    if isinstance(loop.fidelity, FidelityPart) and not loop.fidelity.explained:
        yield "sampling, delay and hold do not explain the difference to the ideal loop"
    if loop.missing_samples:
        where = ", ".join(f"{n} of {t}" for t, n in loop.missing_by_table.items())
        yield f"{loop.missing_samples} samples are missing from the record: {where}"
    if loop.unintended_losses:
        where = ", ".join(f"{n} on {leg}" for leg, n in loop.unintended_losses_by_leg.items())
        lost = f"{loop.unintended_losses} datagrams were lost elsewhere"
        if has_clocks(loop):
            yield f"{lost} (kernel, or between the hosts; firewalls must pass the ports): {where}"
        else:
            yield f"{lost} (kernel): {where}"
    for restart in loop.restarts:
        yield f"{restart.process} was restarted, {away(restart)}; claims are void from then on"
    for when, what in changes_in(loop.changes):
        yield f"{when}: {what}"
    for role, reasons in loop.rejected_datagrams.items():
        counts = ", ".join(f"{reason.replace('_', ' ')} {n}" for reason, n in reasons.items())
        yield f"{role} rejected datagrams: {counts}"
    # Claims are void because this machine was late.
    causes = {one.cause for one in loop.assumption_violations} & {"delay", "hold"}
    if causes and summary.kind == "live" and not loop.restarts:
        what = "A host or the network between hosts" if has_clocks(loop) else "This machine"
        yield (
            f"{what} was late, so some claims were not judged to the end. To allow more "
            "lateness, raise certificate.late_periods."
        )
    if has_clocks(loop) and loop.replay is not None and not loop.replay.complete:
        yield (
            "the record is incomplete. A process that could not reach the recorder prints the "
            "folder of the rest; add it: noack collect RUN_DIRECTORY HOST:FOLDER"
        )
