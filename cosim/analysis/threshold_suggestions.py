"""Which smaller threshold brings an output within its allowed error, where the bound exceeds it.

Without disturbances and noise a bound that does not decay is proportional to the threshold's constant
part. So the first value that is tried is what this proportion gives, a little smaller; it counts only
if the checker proves it. With disturbances smaller values follow, as far as they help.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from cosim.analysis.settings_with_certificates import replaced
from cosim.analysis.witnesses import find_statement
from netem.core.errors import NoackError
from netem.core.number_format import at_most, to_digits
from noack.core.progress import Progress
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.certificates.output_bounds import OutputBound

_THRESHOLDS = ("floor", "delta", "epsilon")
"""Keys of triggers with the part of their threshold that does not decay."""
_ROOM, _TRIES = 0.9, 3


@dataclass(frozen=True)
class ThresholdTrials:
    """Trials of smaller thresholds of a resolved scenario with a linear plant."""

    scenario: Scenario
    plants: str
    """"own" or "box"."""

    def advice(self, bound: OutputBound, index: int, progress: Progress) -> str:
        """Return which threshold brings an output within its allowed error, in words.

        Args:
            bound: that of the output, which exceeds the allowed error in the end.
            index: the output's place among those of the loop.
            progress: called with the completed share.
        """
        trigger, output = self.scenario.trigger, bound.output
        key = next((key for key in _THRESHOLDS if getattr(trigger, key, None)), None)
        assert output.allowed is not None
        if key is None:
            return "disturbances and noise make its bound that large, not the threshold"
        value, ultimate = float(getattr(trigger, key)), bound.ultimate
        for number in range(_TRIES):
            value = to_digits(_ROOM * value * output.allowed / max(ultimate, output.allowed), 2)
            proven = self._ultimate({f"trigger.{key}": value}, f"y[{index}]")
            progress((number + 1) / _TRIES)
            if proven is None:
                return f"with trigger.{key} = {value:g} nothing is proven"
            if proven <= output.allowed:
                return f"trigger.{key} = {value:g} is small enough (proved)"
            ultimate = proven
        least = output.quantity(at_most(ultimate, 2))
        return (
            f"with trigger.{key} = {value:g} its bound is {least} still. Allow more, or fewer losses, or "
            "use a gain that suppresses disturbances more"
        )

    def _ultimate(self, values: Mapping[str, float], name: str) -> float | None:
        """Return the proven bound of an output in the end with other settings; None: nothing is proven."""
        content = dict(self.scenario.content())
        for key, value in values.items():
            content = replaced(content, key.split("."), value)
        try:
            changed = resolve(validate(content, self.scenario.name))
        except NoackError:
            return None
        bounds = find_statement(changed, self.plants, "schedule").bounds
        if bounds is None or name not in bounds.bounds:
            return None
        return min(bounds.bounds[name].constant, bounds.limits.get(name, math.inf))
