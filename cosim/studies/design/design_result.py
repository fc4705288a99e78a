"""The result of a design, as text and as numbers."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from cosim.studies.design.candidate_measures import (
    Bounded,
    Bounds,
    CandidateMeasures,
    DesignLimits,
    Trial,
)
from cosim.studies.design.design_space import DesignSpace
from noack.config.scenario import Scenario
from noack.core.number_format import plus_minus

_DESIGNED = "_designed"
WORDS: dict[Bounded, str] = {"state": "sup‖x‖", "error": "sup‖e_c‖"}


@dataclass(frozen=True)
class DesignResult:
    """The result of a design."""

    space: DesignSpace
    limits: DesignLimits
    trials: Sequence[Trial]
    """All candidates that were tried."""
    front: Sequence[Trial]
    """The trade-off curve, by ascending transmissions."""
    best: Trial
    """The candidate with the fewest transmissions within the limits, or the closest to them."""
    fresh: CandidateMeasures
    """Measures of the best candidate on new draws, which the search did not use."""
    bounds: Bounds | None
    """Certified bounds of the best candidate; None if there are none."""
    seed: int

    @property
    def feasible(self) -> bool:
        """Whether the best candidate meets the limits with the upper end of its interval."""
        return self.best.excess(self.limits) == 0

    @property
    def confirmed(self) -> bool:
        """Whether the quantile itself also meets the limit on the new draws."""
        return self.feasible and self.fresh.settling_s <= self.limits.settling_s

    @property
    def scenario(self) -> Scenario:
        """The scenario of the best candidate, under a new name."""
        family = self.space.families[self.best.candidate.family]
        chosen = family.with_trigger(self.best.candidate)
        limits = self.limits
        return chosen.model_copy(
            update={
                "name": f"{chosen.name.removesuffix(_DESIGNED)[: 64 - len(_DESIGNED)]}{_DESIGNED}",
                "description": f"{chosen.name} with the trigger that transmits least while "
                f"{100 * limits.quantile:g} % of draws settle within {limits.settling_s:g} s.",
            }
        )

    @property
    def conditions(self) -> str:
        """The conditions of the certified bounds."""
        kind = "the scenario's schedule" if self.limits.schedule else "the paper's conditions"
        return f"under {kind}, for the whole box"

    def verdict(self) -> str:
        """The verdict in one line."""
        if self.confirmed:
            sent = plus_minus(self.fresh.transmissions, self.fresh.halfwidth)
            return f"{sent} transmissions, settled after {self._settling(self.fresh)}: {self._at()}"
        if self.feasible:
            return (
                f"not confirmed: on fresh draws it takes {self._settling(self.fresh)}, "
                f"{self.limits.settling_s:g} s are allowed; take more --draws"
            )
        return f"no design meets the limits; the closest has {self._missed()}, at {self._at()}"

    def document(self) -> dict[str, Any]:
        """Return the result as JSON."""
        limits = asdict(self.limits)
        limits["under"] = "schedule" if limits.pop("schedule") else "paper"
        bounds = None if self.bounds is None else dict(self.bounds)
        matrices = {"W": self.scenario.decaying.weight, "K": self.scenario.model.gain}
        best = {**self._row(self.best), **matrices, "fresh": self.fresh._asdict(), "bounds": bounds}
        return {
            "scenario": self.space.families[0].scenario.name,
            "limits": limits,
            "seed": self.seed,
            "tried": len(self.trials),
            "feasible": self.feasible,
            "confirmed": self.confirmed,
            "verdict": self.verdict(),
            "best": best,
            "front": [self._row(trial) for trial in self.front],
        }

    def _row(self, trial: Trial) -> dict[str, Any]:
        number, alpha_per_s, beta = trial.candidate
        family = self.space.families[number]
        trigger = {"alpha_per_s": alpha_per_s, "beta": beta}
        names = {"gain": family.gain, "weight": family.weight}
        return {**names, **trigger, **trial.measured._asdict()}

    def _at(self) -> str:
        one = self.best.candidate
        name = self.space.families[one.family].name
        return f"α = {one.alpha_per_s:.4g} /s, β = {one.beta:.4g}, weight {name}"

    def _settling(self, measured: CandidateMeasures) -> str:
        return f"{seconds(measured)} in {100 * self.limits.quantile:g} % of draws"

    def _missed(self) -> str:
        """Return the limits that are exceeded, with the amounts."""
        measured, missed = self.best.measured, []
        if measured.settling_high_s > self.limits.settling_s:
            missed.append(
                f"a settling time of {self._settling(measured)} "
                f"({self.limits.settling_s:g} s allowed)"
            )
        for name, limit in self.limits.bounds.items():
            value = self.best.bounds[name]
            if value > limit:
                missed.append(f"{certified(name, value)} ({limit:g} allowed)")
        return " and ".join(missed)


def certified(name: Bounded, value: float) -> str:
    """Return a certified bound as text."""
    if not math.isfinite(value):
        return f"no certified bound of {WORDS[name]}"
    return f"{WORDS[name]} ≤ {value:.4g}"


def seconds(measured: CandidateMeasures) -> str:
    """Return the quantile of the settling times with its interval, as text."""
    low, at, high = (
        f"{value:.4g}" if math.isfinite(value) else "∞"
        for value in (measured.settling_low_s, measured.settling_s, measured.settling_high_s)
    )
    return f"{at} s [{low}, {high}]"
