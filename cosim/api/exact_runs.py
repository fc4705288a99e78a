"""Runs in exact continuous time, without a record."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cosim.api.scenarios import Source, load
from cosim.output import curves
from cosim.output.curves import Curve
from cosim.output.run_verdict import verdict_of_exact_run
from cosim.simulation import continuous
from netem.core.number_checks import whole_number
from netem.output.document import Sentence
from noack.core.linear_systems import Matrix, Vector
from noack.scenario.resolution import policy_of, resolve
from noack.scenario.scenario import Scenario
from noack.trigger_policies.trigger_rule import TriggerRule

_POINTS = 400
"""Number of evenly spaced times; each event adds the times just before and after it."""
_MOST_EVENT_POINTS = 600
"""With more events, only the evenly spaced times are in the curves."""
_MOST_EVENTS = 10_000_000
"""Most transmissions that may be asked for."""


class ExactRun:
    """A run in exact continuous time; :func:`noack.simulate_exactly` returns it.

    >>> import noack
    >>> run = noack.simulate_exactly("lane_following")
    >>> run.event_s.shape == run.delivered.shape  # times of the transmissions, in seconds
    True
    >>> print(run.verdict[0].text)
    completed 20 s: stable, ‖x‖ fell from 3.04 to 0.0168
    """

    scenario: Scenario
    """The resolved scenario."""

    def __init__(self, scenario: Scenario, run: continuous.ContinuousRun) -> None:
        self.scenario, self._run = scenario, run

    @property
    def event_s(self) -> Vector:
        """Times of the transmissions, (k,)."""
        return self._run.event_s

    @property
    def delivered(self) -> NDArray[np.bool_]:
        """Whether each transmission arrived, (k,)."""
        return self._run.delivered

    @cached_property
    def summary(self) -> continuous.ContinuousSummary:
        """The numbers of the run, with the names of a loop's in ``summary.json``."""
        return continuous.summary(self._run, self.scenario)

    @property
    def verdict(self) -> list[Sentence]:
        """How the run ended and its transmissions: lines with ``text`` and ``tone``."""
        return verdict_of_exact_run(self.summary)

    @np.errstate(all="ignore")  # a run may diverge
    def curves(self) -> list[Curve]:
        """Return the run's signals as a table, as :meth:`noack.Run.curves`, without inputs and bounds."""
        run, scenario = self._run, self.scenario
        samples = run.at(np.linspace(0.0, run.reached_s, _POINTS))
        parts = [(samples.t_s, samples.x, samples.e_s, samples.e_c)]
        if 0 < len(run.before) <= _MOST_EVENT_POINTS:  # at an event: before, after, then the even times
            parts = [_stacked(run.before), _stacked(run.after), *parts]
        t_s, x, e_s, e_c = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(t_s, kind="stable")
        t_s, x, e_s, e_c = t_s[order], x[order], e_s[order], e_c[order]
        unknown = ~self._has_controller_state(t_s)
        e_c_norm = run.system.norms(e_c)
        e_c[unknown], e_c_norm[unknown] = np.nan, np.nan
        names, units = run.system.loop.state_names, scenario.named_model.state_units
        stated = scenario.loop_outputs() if scenario.outputs else ()
        distances = [(output, np.abs(x @ np.array(output.row))) for output in stated]  # x_r is 0
        return [
            *curves.state_curves(names, t_s, x, x + e_s, x + e_c, units=units),
            *(curve for output, y in distances for curve in curves.output_curves(output, t_s, y)),
            *curves.error_curves(t_s, run.system.norms(e_s), e_c_norm, _threshold(scenario, t_s)),
            curves.norm_curve(t_s, np.linalg.norm(x, axis=1)),
            *curves.transmission_curves(run.event_s, run.delivered),
        ]

    def _has_controller_state(self, t_s: Vector) -> NDArray[np.bool_]:
        """Return whether the controller has a state at times (k,): not before its first update."""
        if self.scenario.network.initial_sync == "known_state":
            return np.ones(len(t_s), np.bool_)
        first_s = self.event_s[self.delivered].min(initial=np.inf)
        # If the time of the event occurs twice, it is first the time before the reset.
        start = np.searchsorted(t_s, first_s) + (np.count_nonzero(t_s == first_s) > 1)
        return np.asarray(np.arange(len(t_s)) >= start)

    def __repr__(self) -> str:
        return "\n".join(line.text for line in self.verdict)


def _stacked(states: tuple[continuous.LoopState, ...]) -> tuple[Vector, Matrix, Matrix, Matrix]:
    t_s, x, e_s, e_c = zip(*states, strict=True)
    return np.array(t_s), np.array(x), np.array(e_s), np.array(e_c)


def _threshold(scenario: Scenario, t_s: Vector) -> Vector | None:
    """Return the trigger's threshold at times (k,), if it is a function of time."""
    trigger = policy_of(scenario)
    if not (isinstance(trigger, TriggerRule) and trigger.is_decaying):
        return None
    level: Vector = trigger.level * np.exp(-trigger.rate_per_s * t_s)
    return np.maximum(level, trigger.floor)


def simulate_exactly(scenario: Source, *, most_events: int = 100_000) -> ExactRun:
    """Run the loop of the theory: continuous time, no sampling, no delay; event times are exact.

    It has the scenario's own losses. This takes milliseconds and writes no record;
    :func:`noack.simulate` runs the loop as the processes run it.

    >>> import noack
    >>> run = noack.simulate_exactly("lane_following")
    >>> len(run.event_s), run.summary.deliveries
    (20, 7)

    Args:
        scenario: a scenario, or a source that :func:`noack.load` accepts.
        most_events: largest number of transmissions.

    Raises:
        NoackError: the scenario is wrong; the exact simulation does not cover it, since the plant is
            nonlinear, or has noise, or the network delays; or there are too many transmissions.
    """
    resolved = resolve(load(scenario))
    most_events = whole_number("most_events", most_events, 1, _MOST_EVENTS)
    return ExactRun(resolved, continuous.run_continuous(resolved, most_events))
