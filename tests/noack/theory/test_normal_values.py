"""Bounds in the place of normally distributed values, and runs with them."""

import numpy as np
import pytest
from scipy.stats import norm

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.scenario_certificates import quick_certificate
from cosim.simulation.virtual_time import simulate
from noack.theory.certificates.conditions import with_stated_numbers
from noack.theory.certificates.normal_values import normal_limit
from tests.helpers.shipped import resolved

NORMAL = (
    'plant.disturbances=[{kind="gaussian", std=[0.02]}, {kind="step", amplitude=[0.01]}]',
    "plant.measurement={noise_std=[5e-4, 0.0], noise_bound=[1e-4, 2e-4]}",
    "horizon_s=4",
)


def test_all_values_of_a_run_exceed_their_bounds_with_the_stated_probability() -> None:
    scenario = resolved("double_integrator", *NORMAL)
    limit = normal_limit(scenario)
    assert limit is not None
    values = 2 * (scenario.timing.last_step + 1)
    assert values * 2 * norm.sf(limit) == pytest.approx(1e-6)
    stated = with_stated_numbers(scenario).plant
    first, second = stated.disturbances
    assert (first.kind, second.kind) == ("uniform", "step")
    np.testing.assert_allclose(first.extent(), [[0.02 * limit]])
    assert stated.measurement.noise_std is None
    assert stated.measurement.noise_bound == pytest.approx((1e-4 + 5e-4 * limit, 2e-4))


def test_nothing_changes_without_normal_values() -> None:
    scenario = resolved("double_integrator", "plant.measurement={noise_std=[0.0, 0.0]}")
    assert normal_limit(scenario) is None
    assert with_stated_numbers(scenario).plant.measurement == scenario.plant.measurement


def test_a_normal_disturbance_without_size_is_none() -> None:
    setting = 'plant.disturbances=[{kind="gaussian", std=[0.0]}]'
    undisturbed = quick_certificate(resolved("double_integrator"))
    assert undisturbed.exists
    assert quick_certificate(resolved("double_integrator", setting)).proven == undisturbed.proven


def test_runs_with_normal_values_keep_their_bounds_and_the_assumption_is_named() -> None:
    certificate = quick_certificate(resolved("double_integrator", *NORMAL))
    assert certificate.exists, certificate.void
    (what,) = (each.what for each in certificate.assumptions if "normal values" in each.what)
    assert "probability of at most 1e-06" in what
    for seed in range(3):
        record = simulate(
            resolved("double_integrator", *NORMAL, f"seeds.disturbance={seed}", f"seeds.noise={seed}")
        )
        claims = [claim for claim in RunClaims(record).evaluate() if claim.is_certified]
        assert {claim.verdict for claim in claims} == {"held"}
        assert any("x̂ − x" in claim.bound for claim in claims)
