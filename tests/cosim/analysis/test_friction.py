"""The bounds that are proven of a servo with Coulomb friction hold in runs with each smaller friction."""

import numpy as np
import pytest

from cosim.simulation.virtual_time import simulate
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.certificates.proven_bounds import ProvenBounds
from tests.checker.proofs import proved
from tests.helpers.bound_shares import share_of_bound
from tests.oracles.attacked_regions import SCENARIOS

SERVO = SCENARIOS / "friction_servo.toml"


@pytest.fixture(scope="module")
def proven() -> ProvenBounds:
    return proved("friction_servo").bounds


def test_friction_leaves_the_bound_of_sticking(proven: ProvenBounds) -> None:
    """The shaft sticks where |K₁ angle| k ≤ F; the proven limit is of this size."""
    sticks = 1.0 / (20.0 * 2.0)
    assert sticks < proven.limits["y[0]"] < 4 * sticks


@pytest.mark.parametrize("seed", range(4))
def test_runs_are_inside_the_bounds(proven: ProvenBounds, seed: int) -> None:
    rng = np.random.default_rng(seed)
    friction, share = (1.0, 1.0) if seed == 0 else (rng.uniform(0, 1), rng.uniform(-1, 1))
    settings = [
        f"plant.system.parameters={{friction_rad_per_s2={friction}}}",
        f"plant.initial_state=[{0.5 * share}, 0.0]",
        f"seeds.loss={seed}",
        f"network.loss={{model='bernoulli', probability={rng.uniform(0.3, 1.0)}}}",
    ]
    run = simulate(resolve(load(SERVO, settings)))
    steps = run["plant_step"]
    x, t_ns = steps["x"], steps["t_ns"]
    of_angle = share_of_bound(proven, "y[0]", t_ns, x[:, 0])
    assert max(of_angle, share_of_bound(proven, "x", t_ns, x)) < 1
    assert np.abs(x[-500:, 0]).max() < 1.5 * proven.limits["y[0]"]
    if seed == 0:
        assert of_angle > 0.3
        assert np.abs(x[-1, 0]) > 0.003  # it sticks beside 0
