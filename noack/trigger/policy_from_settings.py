"""The policy that a scenario asks for."""

import numpy as np

from noack.config.resolution import LoopMatrices, loop_of
from noack.config.scenario import Scenario
from noack.config.triggers import (
    AbsoluteSettings,
    AnyTrigger,
    DeadlineSettings,
    DecayingSettings,
    DwellSettings,
    DynamicSettings,
    LyapunovSettings,
    MixedSettings,
    PeriodicSettings,
    QuadraticSettings,
    RelativeSettings,
    SelfTriggeredSettings,
)
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.settings.matrices import Rows
from noack.trigger.absolute import AbsoluteTrigger
from noack.trigger.deadline import DeadlineTrigger
from noack.trigger.decaying import DecayingTrigger
from noack.trigger.dwell import DwellTrigger
from noack.trigger.dynamic import DynamicTrigger
from noack.trigger.lyapunov import LyapunovTrigger
from noack.trigger.mixed import MixedTrigger
from noack.trigger.periodic import PeriodicTrigger
from noack.trigger.quadratic import QuadraticTrigger
from noack.trigger.relative import relative_trigger
from noack.trigger.self_triggered import SelfTrigger
from noack.trigger.trigger_policy import Policy


def policy_of(resolved: Scenario) -> Policy:
    """Return the policy of a resolved scenario.

    Raises:
        CallerError: it needs a closed loop Â + B̂K that is stable, and this one is not.
    """
    return _policy(resolved.trigger, resolved)


def _policy(trigger: AnyTrigger, resolved: Scenario) -> Policy:
    W = None if trigger.weight is None else np.array(trigger.weight)
    match trigger:
        case DecayingSettings():
            return DecayingTrigger(trigger.beta, trigger.alpha_per_s, trigger.floor, W)
        case AbsoluteSettings():
            return AbsoluteTrigger(trigger.delta, W)
        case RelativeSettings():
            return relative_trigger(trigger.sigma, W)
        case MixedSettings():
            return MixedTrigger(trigger.sigma, trigger.epsilon, W)
        case QuadraticSettings():
            return QuadraticTrigger(
                np.array(trigger.Q), _ns(trigger.period_s), trigger.epsilon, trigger.heartbeat, W
            )
        case LyapunovSettings():
            P = _lyapunov(loop_of(resolved), trigger.Q)[0]
            return LyapunovTrigger(
                np.ascontiguousarray(np.linalg.cholesky(P).T), trigger.rate_per_s, W
            )
        case DynamicSettings():
            loop = loop_of(resolved)
            P, Q = _lyapunov(loop, trigger.Q)
            return DynamicTrigger(
                trigger.sigma, trigger.theta_s, trigger.decay_per_s, P, Q,
                loop.B_model @ loop.K, trigger.eta_0, W,
            )  # fmt: skip
        case PeriodicSettings():
            return PeriodicTrigger(_ns(trigger.period_s), W)
        case SelfTriggeredSettings():
            return SelfTrigger(
                trigger.beta, trigger.alpha_per_s, trigger.floor, trigger.growth_per_s,
                trigger.mismatch_per_s, trigger.disturbance_per_s,
                _ns(trigger.shortest_s), _ns(trigger.longest_s), W,
            )  # fmt: skip
        case DeadlineSettings():
            return DeadlineTrigger(_policy(trigger.rule, resolved), _ns(trigger.interval_s))
        case DwellSettings():
            return DwellTrigger(_policy(trigger.rule, resolved), _ns(trigger.interval_s))


def _lyapunov(loop: LoopMatrices, given: Rows | None) -> tuple[Matrix, Matrix]:
    """P and Q with AᵀP + PA = −Q of the model's closed loop."""
    from scipy.linalg import solve_continuous_lyapunov

    A = loop.A_model + loop.B_model @ loop.K
    if spectral_abscissa(A) >= 0:
        raise CallerError(
            "trigger.policy: this one needs a Lyapunov function, but Â + B̂K is not stable"
        )
    Q = np.eye(loop.n) if given is None else np.array(given)
    P = np.asarray(solve_continuous_lyapunov(A.T, -Q), dtype=np.float64)
    return (P + P.T) / 2, Q


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)
