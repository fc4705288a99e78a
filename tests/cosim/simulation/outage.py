"""A run in virtual time with a controller that stands still for a while, as under SIGSTOP.

``python -m tests.cosim.simulation.outage`` prints the table of docs/network.md.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cosim.record.run_record import RunRecord
from noack.machines.run_channel import UserNetwork
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from tests.cosim.simulation.event_scheduler import record_of_run
from tests.helpers.machine_parts import Machine

SCENARIOS = Path(__file__).parents[3] / "scenarios"
NO_OUTAGE = "none"
POLICIES = ("hold", "zero", "model")
STARTS_S = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)
CASES = (
    ("lane_following", "model", 0.5), ("lane_following", "model", 2.0),
    ("lane_following", "zoh", 0.5), ("lane_following", "zoh", 2.0),
    ("unstable_pendulum", "model", 0.5), ("unstable_pendulum", "model", 1.0),
    ("unstable_pendulum", "zoh", 0.5), ("unstable_pendulum", "zoh", 1.0),
)  # fmt: skip


class Frozen:
    """A machine that does nothing during an interval, and then catches up.

    Args:
        machine: the wrapped machine.
        from_ns, until_ns: the interval in which it stands still.
    """

    def __init__(self, machine: Machine[Any], from_ns: int, until_ns: int) -> None:
        self._machine = machine
        self._from_ns, self._until_ns = from_ns, until_ns
        self._waiting: list[Any] = []

    def next_deadline_ns(self) -> int | None:
        due_ns = self._machine.next_deadline_ns()
        frozen = due_ns is not None and self._from_ns <= due_ns < self._until_ns
        return self._until_ns if frozen else due_ns

    def handle(self, message: Any, now_ns: int) -> Sequence[Any]:
        if self._from_ns <= now_ns < self._until_ns:
            self._waiting.append(message)
            return ()
        return self._machine.handle(message, now_ns)

    def on_timer(self, now_ns: int) -> Sequence[Any]:
        late = [out for message in self._waiting for out in self._machine.handle(message, now_ns)]
        self._waiting = []
        return [*late, *self._machine.on_timer(now_ns)]


class LosingMachine:
    """A machine that does not receive some messages, as if they were lost in a socket.

    Args:
        machine: the wrapped machine.
        arrives: maps the number of a sent message to whether it arrives.
    """

    def __init__(self, machine: Machine[Any], arrives: Callable[[int], bool]) -> None:
        self._machine = machine
        self._arrives = arrives
        self._sent = 0
        self.next_deadline_ns, self.on_timer = machine.next_deadline_ns, machine.on_timer

    def handle(self, message: Any, now_ns: int) -> Sequence[Any]:
        self._sent += 1
        return self._machine.handle(message, now_ns) if self._arrives(self._sent - 1) else ()


def simulate_with(
    resolved: Scenario,
    role: str,
    wrap: Callable[[Machine[Any]], Machine[Any]],
    network: UserNetwork | None = None,
) -> RunRecord:
    """Simulate a scenario with the machine of one role replaced."""
    return record_of_run(resolved, network, {role: wrap})


def with_outage(resolved: Scenario, from_s: float, until_s: float) -> RunRecord:
    """Simulate a scenario; its controller stands still from ``from_s`` to ``until_s``."""
    from_ns, until_ns = round(from_s * 1e9), round(until_s * 1e9)
    return simulate_with(resolved, "controller", lambda machine: Frozen(machine, from_ns, until_ns))


def at_the_end(name: str, mode: str, policy: str, lasts_s: float) -> float:
    """‖x‖ at the end of an outage, root mean square over the start times of the outage."""
    squares = []
    for from_s in STARTS_S:
        chosen = "hold" if policy == NO_OUTAGE else policy
        changes = [f"plant.watchdog.policy={chosen}", f"mode={mode}"]
        horizon = f"horizon_s={from_s + lasts_s}"
        resolved = resolve(load(SCENARIOS / f"{name}.toml", [*changes, horizon]))
        lasted_s = 0.0 if policy == NO_OUTAGE else lasts_s
        record = with_outage(resolved, from_s, from_s + lasted_s)
        squares.append(float((record[PLANT_STEP]["x"][-1] ** 2).sum()))
    return math.sqrt(sum(squares) / len(squares))


def row(name: str, mode: str, lasts_s: float) -> str:
    """A row of the table: an outage of ``lasts_s`` under each policy."""
    norms = [at_the_end(name, mode, policy, lasts_s) for policy in (NO_OUTAGE, *POLICIES)]
    numbers = " | ".join(f"{norm:.2g}" for norm in norms)
    return f"| `{name}`, `{mode}` | {lasts_s:g} s | {numbers} |"


if __name__ == "__main__":
    for case in CASES:
        print(row(*case))
