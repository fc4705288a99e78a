"""The next event of one loop, by the core's segments."""

import numpy as np

from cosim.simulation.continuous import ContinuousLoop, LoopState
from cosim.simulation.exact_simulation import OK


def next_event(system: ContinuousLoop, state: LoopState, until_s: float) -> LoopState | None:
    """The next event up to ``until_s`` of a loop just after an event, before its reset."""
    simulation = system.simulation(until_s, known_start=True)
    t_s, start = np.array([state.t_s]), np.array(state[1:])
    found = simulation.segments(system.loop.A, system.loop.B, t_s, start[None])
    assert found.statuses[0] == OK
    return LoopState(float(found.t_s[0]), *found.states[0]) if found.events[0] else None
