"""The paper's loop in exact continuous time, under any policy.

In the coordinates z = (x, e_s, e_c) with e_s = x_s − x and e_c = x_c − x, the loop between events
is linear and autonomous:

    ẋ   = (A+BK) x + BK e_c
    ė_s = H e_s − E x − BK e_c          E = A + BK − H  (eq:miet_errdyn)
    ė_c = (H−BK) e_c − E x

with H = Â+B̂K in model mode and H = 0 under zero-order hold. An event is the first t > t_i at which
‖W e_s(t)‖ exceeds max(βe^{−αt}, ε) (eq:thre), or at which another policy's comparison holds. There
e_s ← 0, and e_c ← 0 if the update arrives. The core follows the loop (native/exact/).
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.exact_simulation import ExactSimulation
from noack.config.resolution import LoopMatrices, loop_of, policy_of
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, Vector
from noack.trigger.decaying import DecayingTrigger
from noack.trigger.trigger_rule import Policy

_SMALLEST_THRESHOLD = 1e-140
"""Below it, the threshold's square or its significant bits would underflow."""


class LoopState(NamedTuple):
    """The loop at a time: plant state and both models' errors, each of shape (n,)."""

    t_s: float
    x: Vector
    e_s: Vector
    e_c: Vector


class Samples(NamedTuple):
    """The loop at k times; states of shape (k, n)."""

    t_s: Vector
    x: Matrix
    e_s: Matrix
    e_c: Matrix

    @property
    def x_s(self) -> Matrix:
        """The sensor's model."""
        return self.x + self.e_s

    @property
    def x_c(self) -> Matrix:
        """The controller's model."""
        return self.x + self.e_c


class ContinuousLoop:
    """The loop in continuous time, under any policy."""

    def __init__(self, loop: LoopMatrices, trigger: Policy) -> None:
        self.loop = loop
        self.trigger = trigger
        self._between = self.simulation(0.0, known_start=True)

    def simulation(self, horizon_s: float, *, known_start: bool, **more: Any) -> ExactSimulation:
        """Return the core's simulation of the loop; further arguments are those of its class."""
        return ExactSimulation(
            self.loop.H, self.loop.K, self.trigger,
            horizon_s=horizon_s, known_start=known_start, **more,
        )  # fmt: skip

    @property
    def generator(self) -> Matrix:
        """G of dz/dt = G z, per second, shape (3n, 3n)."""
        loop, none = self.loop, np.zeros_like(self.loop.H)
        BK = loop.B @ loop.K
        E = loop.A + BK - loop.H
        return np.block([[loop.A + BK, none, BK], [-E, loop.H, -BK], [-E, none, loop.H - BK]])

    @property
    def decaying(self) -> DecayingTrigger:
        """The trigger, which must be the paper's.

        Raises:
            CallerError: the policy is another one.
        """
        if not isinstance(self.trigger, DecayingTrigger):
            raise CallerError(
                "trigger.policy: with a continuous trigger (--trigger continuous) only "
                '"decaying" is searched'
            )
        return self.trigger

    def threshold(self, t_s: float) -> float:
        """Return max(βe^{−αt}, ε) of the paper's trigger."""
        return self.decaying.threshold(t_s * 1e9)

    def norms(self, errors: Matrix) -> Vector:
        """‖W e‖ of k errors, shape (k, n) → (k,)."""
        W = self.trigger.weight
        norms: Vector = np.linalg.norm(errors if W is None else errors @ W.T, axis=-1)
        return norms

    def propagate(self, state: LoopState, t_s: float) -> LoopState:
        """Return the state at ``t_s`` ≥ ``state.t_s``, without events in between."""
        samples = self.sample(state, np.array([t_s]))
        return LoopState(t_s, samples.x[0], samples.e_s[0], samples.e_c[0])

    def sample(self, state: LoopState, t_s: Vector) -> Samples:
        """Return the states at ascending times ≥ ``state.t_s``, without events in between."""
        return self.follow(np.array([state.t_s]), np.array(state[1:])[None], t_s)

    def follow(self, start_s: Vector, starts: NDArray[np.float64], t_s: Vector) -> Samples:
        """Return the states at ascending times, of parts that begin just after events.

        Args:
            start_s: ascending, (k,).
            starts: (k, 3, n); the last one up to a time applies.
            t_s: the times, from the first start on.
        """
        t_s = np.asarray(t_s, dtype=np.float64)
        states = self._between.sample(self.loop.A, self.loop.B, start_s, starts, t_s)
        return Samples(t_s, *np.moveaxis(states, 1, 0))


def reset(state: LoopState, delivered: bool) -> LoopState:
    """Return the state after an event: e_s = 0, and e_c = 0 if the update arrives."""
    nothing = np.zeros_like(state.e_s)
    return LoopState(state.t_s, state.x, nothing, nothing if delivered else state.e_c)


def vanishes_s(trigger: Policy, n: int) -> float:
    """Return the time from which a threshold is too small to compute with; infinity for never."""
    rule = trigger.trigger_rule(n)
    if rule.from_event or rule.rate_per_s == 0 or rule.floor >= _SMALLEST_THRESHOLD:
        return math.inf
    return math.log(rule.level / _SMALLEST_THRESHOLD) / rule.rate_per_s


def vanished(from_s: float) -> CallerError:
    """Return the error of a threshold that decays too far."""
    return CallerError(
        f"trigger: from {from_s:g} s on the threshold is below {_SMALLEST_THRESHOLD:g}, where "
        "errors are within rounding; give trigger.floor or a shorter horizon"
    )


def continuous_loop_of(resolved: Scenario) -> ContinuousLoop:
    """Return the exact loop of a resolved scenario.

    Raises:
        CallerError: exact simulation does not support the scenario.
    """
    try:
        resolved.coverage.require_unchanging()
        resolved.coverage.require_exact()
    except CallerError as error:
        raise CallerError(f"with a continuous trigger (--trigger continuous): {error}") from None
    return ContinuousLoop(loop_of(resolved), policy_of(resolved))
