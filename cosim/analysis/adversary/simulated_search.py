"""The worst loss pattern of a plant that is not given by matrices: each pattern is a simulated run.

A run takes some tenths of a second, so some hundred patterns are tried: regular and random ones, and those
that differ from the worst of them in the outcome of one event. All objectives are evaluated in each run.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from cosim.analysis.adversary.loop_flows import Objective, Pattern
from cosim.analysis.adversary.pattern_search import SearchReport, likely_patterns
from cosim.analysis.adversary.worst_run import WorstRun, reported_value
from cosim.record.align import aligned_parts
from cosim.record.run_record import RunRecord
from cosim.simulation.continuous import network_fates
from cosim.simulation.virtual_time import simulate
from netem.core.clock import NS_PER_S
from netem.core.random_streams import stream
from netem.core.row_operations import row_norms
from netem.guarantee.loss_guarantee import LossAutomaton
from noack.core.linear_systems import Vector
from noack.scenario.scenario import Scenario
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import network_delay_ns

RUNS = 200
"""Runs that are simulated by default, about."""
_GUESSED_SHARE = 0.6
"""Share of the runs before single outcomes are changed."""


class _PatternRun(NamedTuple):
    """A simulated run: of each objective the largest value, and when it is reached."""

    pattern: Pattern
    event_s: tuple[float, ...]
    values: dict[Objective, tuple[float, float | None]]
    shares: tuple[float, ...]
    """The largest share of its bound that each output has."""


class WorstByRuns(NamedTuple):
    """What the search found."""

    objectives: list[WorstRun]
    shares: dict[str, float]
    """The largest share of its certified bound that each stated output has, by the outputs' names."""


def find_worst_by_runs(
    resolved: Scenario,
    objectives: Sequence[Objective],
    certificate: ScenarioCertificate,
    *,
    most_runs: int = RUNS,
    report: SearchReport = lambda step, nodes, value: None,
) -> WorstByRuns:
    """Search the loss patterns of any plant by simulated runs; see :func:`.find_worst`.

    Args:
        resolved: the scenario; every delivered update takes the longest delay that is certified.
        objectives: what is maximised, each for itself.
        certificate: the certificate to compare with.
        most_runs: number of runs, about.
        report: receives the progress.
    """
    runs = _PatternRuns(resolved, certificate, objectives, report)
    lossless, own_fates = runs.of(()), network_fates(resolved)
    events = len(runs.of((False,) * 8 * (len(lossless.pattern) + 1)).pattern)  # losses bring more events
    own = runs.of(tuple(own_fates(event) for event in range(events)))
    for pattern in likely_patterns(resolved.network.guarantee, events, stream(0, "adversary")):
        if runs.count < _GUESSED_SHARE * most_runs:
            runs.of(pattern)
    share = max(most_runs - runs.count, 0) // len(objectives)
    for objective in objectives:
        runs.improve(objective, until=runs.count + share)
    found = []
    for objective in objectives:
        worst = runs.worst(objective)
        value, at_s = worst.values[objective]
        found.append(
            WorstRun(
                objective,
                resolved.horizon_s,
                value=reported_value(value, objective),
                at_s=at_s,
                pattern=worst.pattern,
                event_s=worst.event_s,
                exact=math.isinf(value) and value > 0,
                nodes=runs.events,
                runs=runs.count,
                lossless=reported_value(lossless.values[objective][0], objective),
                with_own_network=reported_value(own.values[objective][0], objective),
                certified=_certified(certificate, objective),
            )
        )
    return WorstByRuns(found, runs.shares())


class _PatternRuns:
    """The runs of a scenario, by their patterns."""

    def __init__(
        self,
        resolved: Scenario,
        certificate: ScenarioCertificate,
        objectives: Sequence[Objective],
        report: SearchReport,
    ) -> None:
        self._resolved, self._certificate, self._report = resolved, certificate, report
        self._objectives = objectives
        is_bounded = certificate.has("x") and resolved.outputs is not None
        self._outputs = resolved.loop_outputs() if is_bounded else ()
        self._known: dict[Pattern, _PatternRun] = {}
        self._delay_ns = network_delay_ns(resolved, 0)
        self._aim = objectives[0]
        self.count, self.events = 0, 0
        """The runs, and the events of all of them."""

    def of(self, pattern: Pattern) -> _PatternRun:
        """Return the run of a pattern.

        Updates after its end arrive, and those whose loss the guarantee forbids.
        """
        if pattern not in self._known:
            run = self._simulated(pattern)
            self._known[pattern] = self._known[run.pattern] = run
            self.count, self.events = self.count + 1, self.events + len(run.pattern)
            self._report(self._aim.value, self.events, self.worst(self._aim).values[self._aim][0])
        return self._known[pattern]

    def worst(self, objective: Objective) -> _PatternRun:
        """Return the worst run so far."""
        return max(self._known.values(), key=lambda run: run.values[objective][0])

    def shares(self) -> dict[str, float]:
        """Return the largest share of its bound that each output had in any run."""
        all_shares = [run.shares for run in self._known.values()]
        return {output.name: max(column) for output, *column in zip(self._outputs, *all_shares, strict=True)}

    def improve(self, objective: Objective, until: int) -> None:
        """Change single outcomes of the worst run, up to a number of runs or until none makes it worse."""
        self._aim = objective
        while True:
            worst = self.worst(objective)
            for event, delivered in enumerate(worst.pattern):
                if self.count >= until:
                    return
                changed = self.of((*worst.pattern[:event], not delivered, *worst.pattern[event + 1 :]))
                if changed.values[objective] > worst.values[objective]:
                    break
            else:
                return

    def _simulated(self, pattern: Pattern) -> _PatternRun:
        network = _PatternNetwork(self._resolved, pattern, self._delay_ns)
        record = simulate(self._resolved, network)
        values = {
            objective: _value(record, objective, self._certificate, network.event_s)
            for objective in self._objectives
        }
        shares = tuple(
            _share(record, output.row, self._certificate.of_output(index, output.row))
            for index, output in enumerate(self._outputs)
        )
        return _PatternRun(tuple(network.delivered), tuple(network.event_s), values, shares)


class _PatternNetwork:
    """A network that loses the updates of a pattern, as far as the guarantee allows it."""

    def __init__(self, resolved: Scenario, pattern: Pattern, delay_ns: int) -> None:
        self._pattern, self._delay_ns = pattern, delay_ns
        self._automaton, self._state = LossAutomaton(resolved.network.guarantee), np.zeros(1, int)
        self._first = 0 if resolved.network.initial_sync == "known_state" else 1
        self.delivered: list[bool] = []
        self.event_s: list[float] = []

    def __call__(self, data: bytes, t_ns: int) -> int | None:
        """Return the delay of the next update; None: it is lost."""
        number = len(self.delivered)
        wanted = number < self._first or number >= len(self._pattern) or self._pattern[number]
        if not wanted:
            after = self._automaton.after_loss(self._state)
            wanted = bool(after[0] < 0)
        if number >= self._first:
            self._state = self._automaton.after_delivery(self._state) if wanted else after
        self.delivered.append(wanted)
        self.event_s.append(t_ns / NS_PER_S)
        return self._delay_ns if wanted else None


def _value(
    record: RunRecord, objective: Objective, certificate: ScenarioCertificate, event_s: Sequence[float]
) -> tuple[float, float | None]:
    """Return an objective's value of a run, and when it is reached.

    Of times between events, those after the first input count: others may have no proven bound.
    """
    if objective is Objective.INTER_EVENT:
        later_s = np.array([each for each in event_s if each >= certificate.conditions.start_s])
        if len(later_s) < 2:
            return -math.inf, None
        apart_s = np.diff(later_s)
        at = int(apart_s.argmin())
        return -float(apart_s[at]), float(later_s[at + 1])
    t_ns, sizes = [], []
    for part in aligned_parts(record):
        if objective is Objective.ERROR:
            here = part.aligned.since_delivery(record.scenario)
            t_ns.append(part.aligned.t_ns[here])
            sizes.append(part.aligned.e_c_norm[here])
        else:
            t_ns.append(part.plant.t_ns)
            sizes.append(row_norms(part.plant.x))
    t_s, size = np.concatenate(t_ns) / NS_PER_S, np.concatenate(sizes)
    if not np.isfinite(size).all():
        return math.inf, float(t_s[~np.isfinite(size)][0])
    if objective is Objective.COST:
        return float(np.trapezoid(size**2, t_s)), None
    scaled = size * _relative_level(certificate, objective, t_s)
    at = int(scaled.argmax())
    return float(scaled[at]), float(t_s[at])


def _share(record: RunRecord, row: Sequence[float], bound: ScenarioCertificate) -> float:
    """Return the largest share of its bound that an output has in a run."""
    shares = [
        np.abs(part.plant.x @ np.array(row)) / bound.state(part.plant.t_ns / NS_PER_S)
        for part in aligned_parts(record)
    ]
    return float(np.concatenate(shares).max(initial=0.0))


def _bound(certificate: ScenarioCertificate, objective: Objective, t_s: Vector) -> Vector | None:
    """Return the certified bound of ‖x‖ or of ‖e_c‖_W at times (k,); None: there is none."""
    if objective is Objective.STATE:
        return certificate.state(t_s) if certificate.has("x") else None
    return certificate.controller_error(t_s) if certificate.has("e_c") else None


def _relative_level(certificate: ScenarioCertificate, objective: Objective, t_s: Vector) -> Vector:
    """Return bound(0) / bound(t), (k,); 1 without a bound."""
    bounds = _bound(certificate, objective, np.concatenate([[0.0], t_s]))
    return np.ones(len(t_s)) if bounds is None else bounds[0] / bounds[1:]


def _certified(certificate: ScenarioCertificate, objective: Objective) -> float | None:
    """Return the certified bound at t = 0, or of the inter-event time; None: there is none."""
    if objective is Objective.INTER_EVENT:
        return certificate.inter_event_s
    if objective is Objective.COST:
        return None
    bound = _bound(certificate, objective, np.zeros(1))
    return None if bound is None else float(bound[0])
