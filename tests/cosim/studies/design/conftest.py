"""A small loop and its designs, shared by the tests."""

from pathlib import Path

import pytest

from cosim.studies.design.design_search import DesignLimits, DesignResult, design
from cosim.studies.design.design_space import families_of
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load

SCENARIO = """
name = "mass"
horizon_s = 12.0
[model]
name = "double_integrator"
[plant]
draw = "uniform"
uncertainty_A = [[0.0, 0.0], [0.05, 0.05]]
uncertainty_B = [[0.0], [0.05]]
initial_state = [1.0, 0.0]
rate_hz = 500.0
[trigger]
policy = "decaying"
beta = 0.5
alpha_per_s = 0.25
weight = [[1.5, 0.5], [0.0, 1.0]]
[network]
mansd = 1
loss = { model = "bernoulli", probability = 0.6 }
[controller]
rate_hz = 500.0
"""

LIMITS = DesignLimits(settling_s=9.0, quantile=0.9, settle=0.02, bounds={"error": 0.06})


@pytest.fixture(scope="session")
def mass(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("design") / "mass.toml"
    path.write_text(SCENARIO)
    return path


@pytest.fixture(scope="session")
def scenario(mass: Path) -> Scenario:
    return load(mass)


def designed(scenario: Scenario, limits: DesignLimits, draws: int = 200, seed: int = 3) -> DesignResult:
    families = families_of(scenario, ("identity", "given"), None)
    return design(families, limits, draws=draws, seed=seed)


@pytest.fixture(scope="session")
def result(scenario: Scenario) -> DesignResult:
    return designed(scenario, LIMITS)
