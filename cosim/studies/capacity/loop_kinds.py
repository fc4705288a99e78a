"""The kinds of loops of a capacity study.

The entries of [[loops]] are the kinds; a scenario without them has one. A study keeps the proportions
of their counts: all numbers of loops are multiples of the smallest mixture. A kind that is periodic
in the scenario stays as it is under every policy, and has its own period.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from pydantic import JsonValue

from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.run_sections import LoopSection
from noack.scenario.scenario import Scenario, loop_scenario
from noack.trigger_policies.periodic_trigger import PeriodicSettings

PERIODIC, ZOH, MODEL = "periodic", "zoh", "model"
_PERIOD_PER_TIME_CONSTANT = 0.3
Entry = dict[str, JsonValue]


class LoopKind(NamedTuple):
    """A kind of loop."""

    name: str
    loops: int
    """Number of these loops in the scenario."""
    scenario: Scenario
    """The loop; not resolved."""
    entry: Entry
    """Its entry of [[loops]], without seeds: those of the draws apply."""
    period_s: float
    """Its period under the periodic policy."""

    @property
    def is_periodic(self) -> bool:
        """Whether it is periodic in the scenario."""
        return isinstance(self.scenario.trigger, PeriodicSettings)

    def under(self, change: Mapping[str, JsonValue]) -> Entry:
        """Return its entry with other keys; those that are None are left out."""
        if self.is_periodic:
            return self.entry | {"mode": self.scenario.mode}
        entry = {**self.entry, **change}
        return {key: value for key, value in entry.items() if value is not None}

    def disturbed(self, pulse: Entry, amplitude: float) -> list[Entry]:
        """Return its disturbances, and with an amplitude a pulse on all its inputs."""
        sections = self.scenario.plant.disturbances
        disturbances = [disturbance.model_dump(mode="json", exclude_none=True) for disturbance in sections]
        if amplitude:
            disturbances.append({**pulse, "amplitude": [amplitude] * self.scenario.model.dimensions[1]})
        return disturbances


def kinds_of(scenario: Scenario, period_s: float | None) -> tuple[LoopKind, ...]:
    """Return the kinds of loops of a scenario.

    Args:
        scenario: the scenario, not resolved.
        period_s: period of the periodic policy; None: what each kind needs.

    Raises:
        CallerError: a period is not possible, or all kinds are periodic.
    """
    kinds = []
    for section in scenario.loops or (LoopSection(name="loop"),):
        loop = loop_scenario(scenario, section)
        if isinstance(loop.trigger, PeriodicSettings):
            own_s = loop.trigger.period_s
        else:
            own_s = sampling_period_s(loop) if period_s is None else period_s
        entry = section.model_dump(mode="json", exclude_none=True, exclude={"seeds"})
        kinds.append(LoopKind(section.name, section.count, loop, entry, require_multiple(own_s, loop)))
    if all(kind.is_periodic for kind in kinds):
        raise CallerError(
            'trigger.policy = "periodic": the event-triggered loops need an event-triggered '
            "policy, e.g. --set 'trigger={ policy = \"absolute\", delta = 0.05 }'"
        )
    return tuple(kinds)


def smallest_mixture(kinds: Sequence[LoopKind]) -> int:
    """Return the number of loops of the smallest mixture with the proportions of the scenario."""
    counts = [kind.loops for kind in kinds]
    return sum(counts) // math.gcd(*counts)


def policies_of(kinds: Sequence[LoopKind]) -> dict[str, Entry]:
    """Return the settings of the policies that are always compared."""

    def settings(mode: str, *, periodic: bool = False) -> Entry:
        loops: list[JsonValue] = []
        for kind in kinds:
            change: Entry = {"mode": None}
            if periodic:
                change["trigger"] = {"policy": "periodic", "period_s": kind.period_s}
            loops.append(kind.under(change))
        return {"mode": mode, "loops": loops}

    return {PERIODIC: settings("zoh", periodic=True), ZOH: settings("zoh"), MODEL: settings("model")}


def sampling_period_s(loop: Scenario) -> float:
    """Return the period that a loop needs by the usual rule ω h ≤ 0.3.

    ω is the largest absolute eigenvalue of Â + B̂K; h is a multiple of the measurement period.

    Raises:
        CallerError: h is not shorter than the run.
    """
    system = loop_of(resolve(loop))
    fastest = float(np.abs(np.linalg.eigvals(system.A_model + system.B_model @ system.K)).max())
    measured_s = loop.timing.measurement_period_ns / NS_PER_S
    if fastest * loop.horizon_s <= _PERIOD_PER_TIME_CONSTANT:
        raise CallerError(
            f"--update-period: 0.3 / {fastest:.3g}, from the fastest eigenvalue of A + BK, is not "
            f"shorter than the run of {loop.horizon_s:g} s; give a period"
        )
    return max(math.floor(_PERIOD_PER_TIME_CONSTANT / fastest / measured_s), 1) * measured_s


def require_multiple(period_s: float, loop: Scenario) -> float:
    """Return a period of transmissions; between two measurements there is none.

    Raises:
        CallerError: it is not a multiple of the measurement period.
    """
    measured_ns = loop.timing.measurement_period_ns
    if round(period_s * NS_PER_S) % measured_ns:
        raise CallerError(
            f"--update-period {period_s:g}: not a multiple of the time between two measurements, "
            f"{measured_ns / NS_PER_S:g} s"
        )
    return period_s
