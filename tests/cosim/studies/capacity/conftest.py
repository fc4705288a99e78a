"""The shipped scenario of capacity studies, and plans for it without runs."""

from pathlib import Path

from cosim.studies.capacity.capacity_plan import CapacityPlan
from cosim.studies.capacity.loop_kinds import kinds_of, policies_of
from noack.scenario.scenario_file import load

FILE = Path(__file__).parents[4] / "scenarios" / "shared_bottleneck.toml"
PERIOD_S = 0.1
LOOP = "loops=[{ name = 'loop' }]"


def plan_of(loops: str, counts: tuple[int, ...]) -> CapacityPlan:
    """Return the plan of a study of these [[loops]] and numbers of loops."""
    scenario = load(FILE)
    kinds = kinds_of(load(FILE, [loops]), PERIOD_S)
    return CapacityPlan(scenario, kinds, FILE, {}, PERIOD_S, counts, policies_of(kinds), 0.0, 3, 0)
