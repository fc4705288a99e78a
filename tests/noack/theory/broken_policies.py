"""Certificates of policies that leave out one part of what the trigger does."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any
from unittest.mock import patch

from noack.config.scenario import Scenario
from noack.theory.bounds.terms import Constants, NetworkConditions, TriggerBound
from noack.theory.bounds.trigger_bounds import TriggerBounds
from noack.theory.certificates import scenario_certificates, solution
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.inequalities import BoundMethod, ErrorInequalities
from noack.theory.certificates.scenario_certificates import certify, trigger_bounds
from noack.trigger.error_promise import ErrorPromise

Conditions = NetworkConditions


@dataclass(frozen=True)
class NoShares(TriggerBounds):
    @property
    def promise(self) -> ErrorPromise | None:  # type: ignore[override]
        found = super().promise
        return None if found is None else found._replace(shares=())


@dataclass(frozen=True)
class NoCrossTerm(TriggerBounds):
    @property
    def promise(self) -> ErrorPromise | None:  # type: ignore[override]
        found = super().promise
        return None if found is None else found._replace(shares=found.shares[:1])


@dataclass(frozen=True)
class NoDwell(TriggerBounds):
    def bound(self, conditions: Conditions, level: float, reached: float | None) -> TriggerBound:
        return super().bound(conditions, level, reached)._replace(untested_s=0.0)


@dataclass(frozen=True)
class NoTimeOfTheArea(TriggerBounds):
    """Takes the average of ‖e_s‖ for its value now."""

    def bound(self, conditions: Conditions, level: float, reached: float | None) -> TriggerBound:
        found = super().bound(conditions, level, reached)
        return found._replace(ago_s=0.0, also=tuple(one._replace(ago_s=0.0) for one in found.also))


@dataclass(frozen=True)
class AThirdOfTheTime(TriggerBounds):
    """Takes a third of the time up to the next event."""

    def bound(self, conditions: Conditions, level: float, reached: float | None) -> TriggerBound:
        found, h_s = super().bound(conditions, level, reached), conditions.sampling_s
        assert not all(one.is_tested for one in found.every)

        def wrong(one: TriggerBound) -> TriggerBound:
            third_s = (one.untested_s + h_s) / 3
            return one if one.is_tested else one._replace(untested_s=third_s - h_s)

        return wrong(found)._replace(also=tuple(map(wrong, found.also)))


def with_trigger(kind: type[TriggerBounds]) -> Callable[[Scenario, Conditions], Any]:
    def broken(resolved: Scenario, conditions: Conditions) -> ScenarioCertificate:
        true = trigger_bounds(resolved)
        wrong = kind(true.rule, true.weight, true.fastest_per_s)
        with patch.object(scenario_certificates, "trigger_bounds", lambda resolved: wrong):
            return certify(resolved, conditions)

    return broken


def without_one_loss(resolved: Scenario, conditions: Conditions) -> ScenarioCertificate:
    return certify(resolved, conditions._replace(dropouts=conditions.dropouts - 1))


def with_own_ways(resolved: Scenario, conditions: Conditions) -> ScenarioCertificate:
    """Each part bounds e_c in the way that is tighter for it, and the bounds are added."""

    true = solution._smallest

    def smallest(
        steps: Sequence[ErrorInequalities], spacing_s: float
    ) -> tuple[list[Constants], BoundMethod]:
        found = [true([step], spacing_s) for step in steps]
        return [constants for (constants,), _ in found], found[0][1]

    with patch.object(solution, "_smallest", smallest):
        return certify(resolved, conditions)


INSTANT = {"delay_steps": 0, "hold_steps": 0, "known_start": True, "window": (1, 1), "recovery": 0}
FAR = {"n": 1, "m": 1, "mismatch": 0.5, "step_share": 0.01, "sample_steps": 1, **INSTANT}

BROKEN_POLICIES: dict[str, tuple[str, Callable[[Scenario, Conditions], Any], dict[str, Any]]] = {
    **{
        f"{kind}, one loss less": (kind, without_one_loss, {**FAR, "mansd": 1, "beta": 0.01})
        for kind in ("absolute", "mixed", "quadratic", "deadline", "self_triggered")
    },
    "absolute, each part its own bound of e_c": (
        "absolute", with_own_ways,
        {**FAR, "mansd": 0, "beta": 0.01, "delay_steps": 4, "step_share": 0.002},
    ),
    "relative, no share": ("relative", with_trigger(NoShares), {**FAR, "mansd": 0}),
    "mixed, no share": ("mixed", with_trigger(NoShares), {**FAR, "mansd": 0, "beta": 0.01}),
    "quadratic, no cross term": (
        "quadratic", with_trigger(NoCrossTerm), {**FAR, "mansd": 0, "beta": 0.01},
    ),
    "dwell, no growth before the test": (
        "dwell", with_trigger(NoDwell), {**FAR, "mansd": 0, "beta": 0.01},
    ),
    "send_on_area, no growth after the average": (
        "send_on_area", with_trigger(NoTimeOfTheArea), {**FAR, "mansd": 0, "beta": 0.01},
    ),
    "periodic, a third of the period": (
        "periodic", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0},
    ),
    "deadline, a third of the deadline": (
        "deadline", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0, "beta": 1.0},
    ),
    "self_triggered, a third of the longest time": (
        "self_triggered", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0},
    ),
    "deadline of lyapunov, a third of the deadline": (
        "lyapunov", with_trigger(AThirdOfTheTime), {**FAR, "mansd": 0},
    ),
}  # fmt: skip
"""By the mistake: the policy, its wrong certificate, and loops in which the mistake matters."""
