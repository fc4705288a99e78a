"""The loop as the processes run it, for the search: every policy, sampled, held and delayed.

Disturbances and noise are those that the scenario's seeds draw. The suprema are those at the
plant's steps; the integral is a sum over them.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from cosim.analysis.adversary.objective import Objective
from cosim.analysis.adversary.pattern_flow import Flags, Segments
from cosim.simulation.sampled_loop import Numbers, Runs, SampledLoop, Scales
from noack.core.linear_systems import Matrix, Vector
from noack.theory.certificates.certified_bounds import ScenarioCertificate

_TINY = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class SampledFlow:
    """A :class:`PatternFlow`; values are relative to the shape of a certificate's bounds.

    The bound of ‖x‖ is X(0) · level(t), with level(0) = 1; the value is sup ‖x‖ / level(t). That of
    ‖W e_c‖ likewise. Without a certificate the level is 1.
    """

    loop: SampledLoop
    objective: Objective
    certificate: ScenarioCertificate
    _scales: Scales = field(init=False, compare=False)

    def __post_init__(self) -> None:
        """Compute the levels."""
        scales = Scales(
            self.loop.weight,
            *(
                bound[0] / np.maximum(bound, _TINY) if bound[0] > 0 else np.ones(len(bound))
                for bound in (self._bound(True), self._bound(False))
            ),
        )
        object.__setattr__(self, "_scales", scales)

    @property
    def horizon_s(self) -> float:
        """End of the runs."""
        return self.loop.last * self.loop.step_s

    @property
    def certified(self) -> float | None:
        """The certificate's bound of the objective; None without one."""
        if self.certificate.constants is None:
            return None
        if self.objective is Objective.INTER_EVENT:
            return self.certificate.inter_event_s
        bound = self._bound(self.objective is Objective.ERROR)
        if self.objective is Objective.COST:
            return float((bound[1:] ** 2).sum() * self.loop.step_s)
        return float(bound[0])

    def start(self) -> Segments:
        """As :meth:`PatternFlow.start`."""
        runs = self.loop.start()
        value = self.objective.nothing
        if self.objective is Objective.STATE:
            value = float(np.linalg.norm(runs.x[0]))
        return Segments(self._time(runs.step), _packed(runs), runs.is_event, np.array([value]))

    def after_events(self, t_s: Vector, z: Matrix, delivered: Flags) -> Matrix:
        """As :meth:`PatternFlow.after_events`."""
        runs = self._runs(t_s, z)
        self.loop.update(runs, delivered)
        return _packed(runs)

    def __call__(self, t_s: Vector, z: Matrix, known: float = -np.inf) -> Segments:
        """As :meth:`PatternFlow.__call__`."""
        runs = self._runs(t_s, z)
        self.loop.follow(runs, self._scales, np.full(len(t_s), self.loop.last))
        end_s = at_s = self._time(runs.step)
        value = self._value(runs)
        if self.objective is Objective.INTER_EVENT:
            value = np.where(runs.is_event & (t_s >= 0.0), t_s - end_s, -np.inf)
        elif not self.objective.additive:
            of_error = self.objective is Objective.ERROR
            at_s = self._time(runs.error_at if of_error else runs.state_at)
        return Segments(end_s, _packed(runs), runs.is_event, value, at_s)

    def promise(self, t_s: Vector, z: Matrix, window_s: float) -> Vector:
        """As :meth:`PatternFlow.promise`: the value over the window without events.

        Large errors of the controller lead to early events.
        """
        runs = self._runs(t_s, z)
        until = np.minimum(runs.step + round(window_s / self.loop.step_s), self.loop.last)
        self.loop.follow(runs, self._scales, until, tests=False)
        return self._value(runs)

    def features(self, t_s: Vector, z: Matrix) -> Matrix:
        """As :meth:`PatternFlow.features`."""
        runs = self._runs(t_s, z)
        step = np.maximum(runs.step, 0)
        state, error = self._scales.state[step, None], self._scales.error[step, None]
        parts = [
            runs.x * state, (runs.x_s - runs.y) * error, (runs.x_c - runs.y) * error,
            runs.u * state, runs.updates.reshape(len(z), -1) * state,
            runs.sent, runs.auxiliary[:, None],
        ]  # fmt: skip
        return np.hstack([part / (np.abs(part).max(initial=0.0) or 1.0) for part in parts])

    def _time(self, step: Numbers) -> Vector:
        return np.asarray(step * self.loop.step_s, dtype=np.float64)

    def _value(self, runs: Runs) -> Vector:
        """Return the value of segments, (N,)."""
        if self.objective is Objective.STATE:
            return runs.state
        return runs.cost if self.objective is Objective.COST else runs.error

    def _bound(self, of_error: bool) -> Vector:
        """Return the bound of ‖W e_c‖ or of ‖x‖ at each step; 1 without a certificate."""
        t_s = self._time(np.arange(self.loop.last + 1))
        if self.certificate.constants is None:
            return np.ones(len(t_s))
        return self.certificate.controller_error(t_s) if of_error else self.certificate.state(t_s)

    def _runs(self, t_s: Vector, z: Matrix) -> Runs:
        """Return runs with a copy of states in rows, (N, entries)."""
        runs = self.loop.empty(len(t_s))
        step: Numbers = np.rint(t_s / self.loop.step_s).astype(np.int64)
        runs.step[:] = step
        begin = 0
        for part in _states(runs):
            columns = math.prod(part.shape[1:])
            part[:] = z[:, begin : begin + columns].reshape(part.shape)
            begin += columns
        return runs


def _states(runs: Runs) -> tuple[Matrix, ...]:
    """Return the arrays of which a run's state consists."""
    return (
        runs.x, runs.y, runs.x_s, runs.x_c, runs.u, runs.u_next, runs.sent, runs.updates,
        runs.auxiliary,
    )  # fmt: skip


def _packed(runs: Runs) -> Matrix:
    """Return the states in rows, (N, entries)."""
    count = len(runs.step)
    return np.hstack([part.reshape(count, math.prod(part.shape[1:])) for part in _states(runs)])
