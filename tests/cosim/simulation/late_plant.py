"""Runs whose plant steps late: such a step applies inputs that were computed for a later time."""

from collections.abc import Callable
from pathlib import Path

from cosim.record.run_record import RunRecord
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.simulation.event_scheduler import RANKS, EventScheduler

CASE = Path(__file__).parents[2] / "cases" / "lead.toml"
STEP_S = 0.002
Lateness = Callable[[int], int]
"""By how many steps a step of the plant is late, by its number."""


class LatePlant(EventScheduler):
    """A simulation in which steps of the plant are late."""

    late: Lateness

    def _next(self) -> tuple[int, int, str] | None:
        due = [(self._now_ns, 2, "")] if self._sent else []
        for role, rank in {**RANKS, "plant": 5}.items():
            t_ns = self.machines[role].next_deadline_ns()
            if t_ns is not None:
                late_s = self.late(round(t_ns * 1e-9 / STEP_S)) * STEP_S if role == "plant" else 0.0
                due.append((max(t_ns + round(late_s * 1e9), self._now_ns), rank, role))
        return min(due, default=None)


def late_run(late: Lateness, *settings: str) -> RunRecord:
    """Return the record of a simulated run with late steps."""
    run = LatePlant(resolve(load(CASE, list(settings))))
    run.late = late
    run.run()
    return run.record()
