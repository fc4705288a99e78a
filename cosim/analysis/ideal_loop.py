"""The difference between a run and the ideal loop.

The ideal loop is the paper's, with the plant and the trigger policy of the run: the trigger is
tested at all times, and an update acts without delay. It loses the updates of the same numbers as
the run. Updates that the run did not have get the fates that the network emulator decides, which
depend on its seed only.
"""

import numpy as np

from cosim.analysis.summary.summary_model import IdealLoopPart, LoopSummary, NoIdealLoopPart
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import (
    ContinuousRun,
    TooManyEventsError,
    continuous_loop_of,
    network_fates,
    simulate_continuous,
)
from netem.core.errors import NoackError
from noack.protocol.record_tables import CONTROLLER_DELIVERY, PLANT_STEP
from noack.scenario.scenario import Scenario
from noack.theory.coverage import require_exact

_MORE_EVENTS = 10_000
"""The ideal loop has at most twice the events of the run, and these; an unstable one has any number."""
_AT_THE_END = 1e-11
"""The ideal loop runs longer, relative: an event at the last step may be due after rounding."""


class IncomparableError(NoackError):
    """The run has no comparison; the message has the reason."""


def ideal_loop_part(record: RunRecord, summary: LoopSummary) -> IdealLoopPart | NoIdealLoopPart:
    """Return the comparison for a loop's summary, or the reason why there is none."""
    try:
        return compare_with_ideal(record, summary)
    except NoackError as error:
        return NoIdealLoopPart(reason=str(error))
    except Exception as error:  # a failed comparison is no failure of the run
        return NoIdealLoopPart(reason=repr(error))


def compare_with_ideal(record: RunRecord, summary: LoopSummary) -> IdealLoopPart:
    """Compare the plant's state with that of the ideal loop, at the plant's steps.

    The loop's summary says how complete the record is, and what happened.

    Raises:
        NoackError: the ideal loop does not exist, or not for all that happened in the run.
    """
    last_ns = record.last_ns(PLANT_STEP)
    _require(record.scenario, summary, complete=bool(last_ns))
    ideal = _ideal_loop(record, (last_ns or 0) * 1e-9 * (1 + _AT_THE_END))
    differences, squares, count = 0.0, 0.0, 0
    for part in record.slices(PLANT_STEP, columns=("t_ns", "x")):
        x = part[PLANT_STEP]["x"]
        differences += float(((x - ideal.at(part[PLANT_STEP]["t_ns"] * 1e-9).x) ** 2).sum())
        squares += float((x**2).sum())
        count += len(x)
    return IdealLoopPart(
        reason=None,
        rms_difference=float(np.sqrt(differences / count)),
        rms_x=float(np.sqrt(squares / count)),
        events=len(ideal.event_s),
    )


def _require(scenario: Scenario, summary: LoopSummary, *, complete: bool) -> None:
    """Raise an error unless the run is one of a loop with an exact simulation."""
    scenario.coverage.require_unchanging()
    require_exact(scenario)
    watchdog, safe_input = summary.watchdog, scenario.controller.safe_input
    reasons = {
        "settings were changed during the run": bool(summary.changes),
        "the run diverged": summary.diverged_at_s is not None,
        "the record is not complete": bool(summary.missing_samples) or not complete,
        "the watchdog replaced the input": bool(watchdog.trips) and watchdog.policy != "hold",
        "the controller has a safe input": safe_input is not None and any(safe_input),
    }
    for reason, applies in reasons.items():
        if applies:
            raise IncomparableError(reason)


def _ideal_loop(record: RunRecord, until_s: float) -> ContinuousRun:
    """Simulate the ideal loop with the fates of the run's updates."""
    scenario, sent = record.scenario, len(record.events())
    arrived = set(record.columns(CONTROLLER_DELIVERY, "sequence")["sequence"].tolist())
    decided, most_events = network_fates(scenario, record.number), 2 * sent + _MORE_EVENTS
    try:
        ideal = simulate_continuous(
            continuous_loop_of(scenario),
            horizon_s=until_s,
            delivered=lambda event: event in arrived if event < sent else decided(event),
            known_start=scenario.network.initial_sync == "known_state",
            max_events=most_events,
        )
    except TooManyEventsError:
        raise IncomparableError(
            f"in continuous time the events accumulate (more than {most_events:,}), so there is no ideal "
            "loop; a stable loop, a larger threshold or a floor would keep them apart"
        ) from None
    if ideal.diverged_at_s is not None:
        raise IncomparableError(f"the ideal loop diverges at {ideal.diverged_at_s:g} s")
    return ideal
