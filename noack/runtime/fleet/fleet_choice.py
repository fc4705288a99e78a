"""Whether the machines of a run's loops run as compiled code."""

from collections.abc import Sequence

from noack.config.fleet_layout import FleetRole
from noack.config.resolution import resolved_loops
from noack.config.runtime_parameters import is_of_network_alone
from noack.config.scenario import Scenario
from noack.core.code_cache import while_compiling
from noack.core.errors import CallerError
from noack.protocol.datagram_seal import KEY_BYTES
from noack.runtime.command_line import print_to_stderr
from noack.runtime.fleet.compiled_driver import (
    compiled_driver,
    compiled_replay,
    kept_driver,
    kept_replay,
)
from noack.runtime.fleet.compiled_fleet import CompiledFleet
from noack.runtime.fleet.fleet_replay import replay_arguments
from noack.runtime.peer_sockets import has_peer_sockets

_FEWEST_LOOPS = 4
"""For fewer loops the single machines are used."""
COMPILED_FROM_LOOPS = 20
"""For fewer loops a run does not wait for a compilation."""
_ABOUT_S = 25.0


def may_be_compiled(run: Scenario) -> bool:
    """Whether the machines may be compiled; of such a run only the network can be changed.

    Compiled machines do not encrypt.
    """
    if (
        run.loops is None
        or run.network.encrypted
        or not all(is_of_network_alone(one.set) for one in run.changes)
    ):
        return False
    return sum(section.count for section in run.loops) >= _FEWEST_LOOPS


def fleet_of(
    role: FleetRole, name: str, run: Scenario, run_id: int, key: bytes
) -> CompiledFleet | None:
    """Return the compiled machines of a role; None if the single machines are to be used.

    They are used for few loops, for loops with something that has no compiled form, if more than
    the network changes during the run, if the datagrams are encrypted, and if the
    code is not in the cache.
    """
    driver = kept_driver(role)
    if driver is None or not may_be_compiled(run):
        return None
    fleet = _fleet(role, name, run, resolved_loops(run), (run_id, key))
    if fleet is not None:
        fleet.use(driver)
    return fleet


def prepare(roles: Sequence[tuple[str, FleetRole]], run: Scenario) -> None:
    """Compile the machines of a run with many loops, unless they are in the cache."""
    if not may_be_compiled(run) or len(loops := resolved_loops(run)) < COMPILED_FROM_LOOPS:
        return
    for name, role in roles:
        fleet = _fleet(role, name, run, loops, (0, bytes(KEY_BYTES)))
        if fleet is not None and None in (kept_driver(role), kept_replay(role)):
            what = f"the {name}s of many loops"
            print_to_stderr(f"noack: {while_compiling(what, kept=True, about_s=_ABOUT_S)}")
            compiled_driver(role, fleet.arguments)
            compiled_replay(role, replay_arguments(fleet))


def _fleet(
    role: FleetRole, name: str, run: Scenario, loops: Sequence[Scenario], wire: tuple[int, bytes]
) -> CompiledFleet | None:
    if not has_peer_sockets():
        return None
    try:
        parts = role.parts_of(loops)
    except CallerError:
        return None  # the single machines name the mistake
    return None if parts is None else CompiledFleet(name, role, parts, run, loops, *wire)
