"""One short run, shared by the tests."""

import pytest

import noack

SYSTEM = ([[0.0, 1.0], [9.81, -0.1]], [[0.0], [1.0]])
GAIN = [[-15.0, -5.0]]
TRUE = ([[0.0, 1.0], [9.6, -0.15]], [[0.0], [1.0]])


@pytest.fixture(scope="session")
def scenario() -> noack.Scenario:
    """A pendulum that differs slightly from the model, with a network that loses most updates."""
    settings = {"horizon_s": 4.0, "network.loss.probability": 0.8}
    names = ["angle", "rate"]
    return noack.from_system(SYSTEM, GAIN, [0.2, 0.0], plant=TRUE, state_names=names, settings=settings)


@pytest.fixture(scope="session")
def simulated(scenario: noack.Scenario) -> noack.Run:
    return noack.simulate(scenario)
