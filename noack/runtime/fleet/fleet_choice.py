"""Whether the machines of a run's loops run as compiled code."""

from noack.config.fleet_layout import FleetRole
from noack.config.resolution import resolved_loops
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.runtime.fleet.compiled_driver import kept_driver
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.peer_sockets import has_peer_sockets

FEWEST_LOOPS = 4
"""For fewer loops the single machines take about as long."""


def fleet_of(
    role: FleetRole, name: str, run: Scenario, run_id: int, key: bytes
) -> CompiledFleet | None:
    """Return the compiled machines of a role; None if the single machines are to be used.

    They are used for few loops, for loops with something that has no compiled form, and if the
    code is not in the cache: a run does not wait for a compilation.
    """
    if run.loops is None or not has_peer_sockets():
        return None
    driver = kept_driver(role)
    if driver is None or len(loops := resolved_loops(run)) < FEWEST_LOOPS:
        return None
    try:
        parts = role.parts_of(loops)
    except CallerError:
        return None  # the single machines name the mistake
    if parts is None:
        return None
    fleet = CompiledFleet(name, role, parts, run, loops, run_id, key)
    fleet.use(driver)
    return fleet
