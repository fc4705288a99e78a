"""``noack margin --play``: how long a run must be until it shows that a pattern destabilises."""

from typing import NamedTuple

from cosim.api.runs import simulate
from netem.core.number_format import duration
from noack.scenario.scenario import Scenario

LONGEST_S = 600.0
"""Longest horizon that is chosen."""
_LONGER = 1.25
GROWN = 10.0
"""‖x‖ at the end as a multiple of ‖x‖ at the start, from which on a run shows the growth."""


class PlayedPattern(NamedTuple):
    """A scenario that plays a destabilising pattern, and what its run will show."""

    scenario: Scenario
    expected: str
    """A line."""


def until_it_shows(played: Scenario) -> PlayedPattern:
    """Return the scenario with a horizon at which ‖x‖ has grown, as far as one is found.

    The first seconds show the decay of the other modes: so the runs are tried in virtual time.
    """
    scenario, horizon_s = played, played.horizon_s
    while True:
        (loop,) = simulate(scenario).summary.loops
        if loop.diverged_at_s is not None:
            text = f"the loop diverges, after {duration(loop.diverged_at_s)}"
            return PlayedPattern(scenario, f"expected, as in virtual time: {text}")
        first, final = loop.initial_state_norm or 0.0, loop.final_state_norm or 0.0
        shows = final >= GROWN * first
        if shows or _LONGER * horizon_s > LONGEST_S:
            text = (
                f"expected, as in virtual time: in {horizon_s:g} s ‖x‖ goes from {first:.3g} to {final:.3g}"
            )
            slow = "" if shows else "; the growth is too slow to show within a run of this length"
            return PlayedPattern(scenario, text + slow)
        horizon_s = float(round(_LONGER * horizon_s))
        scenario = played.model_copy(update={"horizon_s": horizon_s})
