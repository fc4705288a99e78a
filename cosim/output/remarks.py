"""Remarks on a run that limit the validity of its numbers, one sentence each."""

from collections.abc import Iterator
from typing import NamedTuple

from cosim.analysis.claims.observed_conditions import CAUSES
from cosim.analysis.run_summary import Summary
from cosim.output.run_tables import away, changes_in
from noack.theory.assumptions import AssumptionStatus

_MOST = 5
_MOST_GROWTH, _MOST_LATE = 10.0, 0.01


class Remark(NamedTuple):
    """One sentence."""

    text: str
    severe: bool = False
    """Whether a guarantee was broken."""


def remarks(summary: Summary) -> Iterator[Remark]:
    """Yield the remarks on a run, the severe ones first; none if all went well."""
    violations = summary["assumption_violations"]
    for one in violations[:_MOST]:
        where = f"t = {one['t_s']:.3f} s (reported by {one['process']})"
        severe = one["cause"] not in CAUSES  # the guarantee, or a change
        yield Remark(f"assumption violated at {where}: {one['what']}", severe=severe)
    if len(violations) > _MOST:
        yield Remark(f"{len(violations) - _MOST} more violations of this kind", severe=True)
    if (summary.get("replay") or {}).get("bit_exact") is False:
        yield Remark("the replay of the run differs from its record", severe=True)
    yield from map(Remark, _warnings(summary))


def has_clocks(summary: Summary) -> bool:
    """Whether bounds of clocks' errors are recorded, as of a run on several hosts."""
    return (summary.get("conditions") or {}).get("clock_error_s") is not None


def _warnings(summary: Summary) -> Iterator[str]:
    for one in summary["assumptions"]:
        if one["verdict"] == AssumptionStatus.VIOLATED:
            yield f"assumption violated: {one['what']} ({one['source']}): {one['why']}"
    late = summary["lateness_us"].get("plant")
    if late and late["late_steps"] > _MOST_LATE * late["steps"]:
        share = 100 * late["late_steps"] / late["steps"]
        yield f"the plant missed {share:.0f} % of its deadlines: lower speed or plant.rate_hz"
    first, last = summary["initial_state_norm"], summary["final_state_norm"]
    grew = first is not None and last is not None and last > _MOST_GROWTH * first > 0
    if grew and summary["diverged_at_s"] is None:  # else it is the reason why the run ended
        yield f"‖x‖ grew from {first:.3g} to {last:.3g} during the run"
    if (summary.get("fidelity") or {}).get("explained") is False:
        yield "sampling, delay and hold do not explain the difference to the ideal loop"
    if summary["missing_samples"]:
        where = ", ".join(f"{n} of {t}" for t, n in summary["missing_by_table"].items())
        yield f"{summary['missing_samples']} samples are missing from the record: {where}"
    if summary["unintended_losses"]:
        where = ", ".join(f"{n} on {leg}" for leg, n in summary["unintended_losses_by_leg"].items())
        lost = f"{summary['unintended_losses']} datagrams were lost elsewhere"
        if has_clocks(summary):
            yield f"{lost} (kernel, or between the hosts; firewalls must pass the ports): {where}"
        else:
            yield f"{lost} (kernel): {where}"
    for one in summary["restarts"]:
        yield f"{one['process']} was restarted, {away(one)}; claims are void from then on"
    for when, what in changes_in(summary):
        yield f"{when}: {what}"
    for role, reasons in summary["rejected_datagrams"].items():
        counts = ", ".join(f"{reason.replace('_', ' ')} {n}" for reason, n in reasons.items())
        yield f"{role} rejected datagrams: {counts}"
    # Claims are void because this machine was late.
    causes = {one["cause"] for one in summary["assumption_violations"]} & {"delay", "hold"}
    if causes and summary["kind"] == "live" and not summary["restarts"]:
        late = "A host or the network between hosts" if has_clocks(summary) else "This machine"
        yield (
            f"{late} was late, so some claims were not judged to the end. To allow more "
            "lateness, raise certificate.late_periods."
        )
    if has_clocks(summary) and (summary.get("replay") or {}).get("complete") is False:
        yield (
            "the record is incomplete. A process that could not reach the recorder prints the "
            "folder of the rest; add it: noack collect RUN_DIRECTORY HOST:FOLDER"
        )
