"""What ``--require`` asks of a scenario's certificates or of a run, and why it is not met.

A requirement is met only where the certificates, or the verdict of the run, say so.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from cosim.analysis.certificates import Certificates
from cosim.analysis.summary.summary_model import LoopSummary, RunSummary
from cosim.output.requirement import Requirement
from cosim.output.run_verdict import guarantee_of, is_covered, state_of
from cosim.simulation.continuous import ContinuousSummary
from netem.core.errors import CallerError, NoackError
from netem.output.result_tables import Tone


@contextmanager
def uncovered_as_unmet(required: Sequence[Requirement]) -> Iterator[None]:
    """Within the context, a scenario that no certificate covers does not meet what is required.

    Raises:
        NoackError: in the place of the CallerError that says so.
    """
    try:
        yield
    except CallerError as error:
        if not required:
            raise
        raise NoackError("\n".join(unmet(word, str(error)) for word in dict.fromkeys(required))) from None


def unmet_by_scenario(results: Certificates, required: Sequence[Requirement]) -> Iterator[str]:
    """Yield for each requirement that a scenario does not meet one line that says why."""
    answer, network = results.answer, results.scenario.network
    for requirement in dict.fromkeys(required):
        why = "" if answer.is_certified else answer.text
        if requirement == Requirement.GUARANTEE and not why and not network.enforce_mansd:
            why = "network.enforce_mansd = false: nothing enforces the guarantee of the losses"
        if requirement == Requirement.STABLE and why and results.is_proven_stable:
            why = ""
        if why:
            yield unmet(requirement, why)


def unmet_by_run(summary: RunSummary, required: Sequence[Requirement]) -> Iterator[str]:
    """Yield for each requirement that a run does not meet one line that says why."""
    for requirement in dict.fromkeys(required):
        reasons = [(loop.name, why) for loop in summary.loops if (why := _unmet_by_loop(loop, requirement))]
        if reasons:
            (name, why), loops = reasons[0], len(summary.loops)
            where = "" if loops == 1 else f"in {len(reasons)} of {loops} loops: {name}: "
            yield unmet(requirement, where + why)


def _unmet_by_loop(loop: LoopSummary, requirement: Requirement) -> str:
    """Return why a loop does not meet a requirement; empty if it does."""
    if requirement == Requirement.STABLE:
        return _not_stable(state_of(loop.sup_state_norm, loop.final_state_norm, loop.diverged_at_s))
    kept = guarantee_of(loop)
    if requirement == Requirement.GUARANTEE:
        broken = "broken" if kept.tone == Tone.BAD else "not checkable"
        return "" if kept.tone == Tone.GOOD else f"{broken}: {kept.why}"
    return "" if is_covered(loop) else kept.why or "no certificate covers the whole run"


def refuse_for_exact_runs(required: Sequence[Requirement]) -> None:
    """Raise CallerError if something is required that a run in continuous time does not check."""
    for requirement in required:
        if requirement != Requirement.STABLE:
            raise CallerError(
                f"--require {requirement}: --trigger continuous checks no claims; leave it out, or use "
                f"noack certify --require {requirement}"
            )


def unmet_by_exact_run(summary: ContinuousSummary, required: Sequence[Requirement]) -> Iterator[str]:
    """Yield why a run in continuous time is not stable, if that is required."""
    state = state_of(summary.sup_state_norm, summary.final_state_norm, summary.diverged_at_s)
    if required and (why := _not_stable(state)):
        yield unmet(Requirement.STABLE, why)


def _not_stable(state: str) -> str:
    return "" if state == "stable" else f"the loop is {state or 'without a recorded state'}"


def unmet(requirement: Requirement, why: str) -> str:
    """Return the line about a requirement that is not met."""
    return f"--require {requirement}: {why}"
