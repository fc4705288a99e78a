"""The kinds of loops of a capacity study, and what each of them becomes under a policy.

The entries of [[loops]] are the kinds; a scenario without them has one. A study keeps the
proportions of their counts: all numbers of loops are multiples of the smallest mixture. A kind that
is periodic in the scenario stays as it is under every policy, and has its own period.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from noack.config.resolution import loop_of, resolve
from noack.config.run_sections import LoopSection
from noack.config.scenario import Scenario, loop_scenario
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.trigger.periodic_trigger import PeriodicSettings

PERIODIC, ZOH, MODEL = "periodic", "zoh", "model"
_PERIOD_PER_TIME_CONSTANT = 0.3
Entry = dict[str, Any]


class Kind(NamedTuple):
    """A kind of loop."""

    name: str
    given: int
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

    def under(self, change: Mapping[str, Any]) -> Entry:
        """Return its entry with other keys; those that are None are left out."""
        if self.is_periodic:
            return self.entry | {"mode": self.scenario.mode}
        changed = {**self.entry, **change}
        return {key: value for key, value in changed.items() if value is not None}

    def disturbed(self, pulse: Mapping[str, Any], amplitude: float) -> list[dict[str, Any]]:
        """Return its disturbances, and with an amplitude a pulse on all its inputs."""
        own = self.scenario.plant.disturbances
        found = [one.model_dump(mode="json", exclude_none=True) for one in own]
        if amplitude:
            found.append({**pulse, "amplitude": [amplitude] * self.scenario.model.dimensions[1]})
        return found


def kinds_of(scenario: Scenario, period_s: float | None) -> tuple[Kind, ...]:
    """Return the kinds of loops of a scenario.

    Args:
        scenario: the scenario, not resolved.
        period_s: period of the periodic policy; None: what each kind needs.

    Raises:
        CallerError: a period is not possible, or all kinds are periodic.
    """
    found = []
    for section in scenario.loops or (LoopSection(name="loop"),):
        loop = loop_scenario(scenario, section)
        if isinstance(loop.trigger, PeriodicSettings):
            own_s = loop.trigger.period_s
        else:
            own_s = sampling_period_s(loop) if period_s is None else period_s
        entry = section.model_dump(mode="json", exclude_none=True, exclude={"seeds"})
        found.append(Kind(section.name, section.count, loop, entry, require_multiple(own_s, loop)))
    if all(kind.is_periodic for kind in found):
        raise CallerError(
            'trigger.policy = "periodic": the event-triggered loops need an event-triggered '
            "policy, e.g. --set 'trigger={ policy = \"absolute\", delta = 0.05 }'"
        )
    return tuple(found)


def smallest_mixture(kinds: Sequence[Kind]) -> int:
    """Return the number of loops of the smallest mixture with the proportions of the scenario."""
    counts = [kind.given for kind in kinds]
    return sum(counts) // math.gcd(*counts)


def policies_of(kinds: Sequence[Kind]) -> dict[str, dict[str, Any]]:
    """Return the settings of the policies that are always compared."""

    def settings(mode: str, *, periodic: bool = False) -> dict[str, Any]:
        changes = [
            {"mode": None} | ({"trigger": _periodic(kind)} if periodic else {}) for kind in kinds
        ]
        loops = [kind.under(change) for kind, change in zip(kinds, changes, strict=True)]
        return {"mode": mode, "loops": loops}

    return {
        PERIODIC: settings("zoh", periodic=True), ZOH: settings("zoh"), MODEL: settings("model"),
    }  # fmt: skip


def _periodic(kind: Kind) -> dict[str, Any]:
    return {"policy": "periodic", "period_s": kind.period_s}


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
