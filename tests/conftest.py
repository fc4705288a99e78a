"""What all tests share: one thread, Hypothesis without wall time or chance, a small scenario."""

import os
from typing import Any

# Before numpy is imported: threads only get into each other's way with small matrices.
os.environ["OPENBLAS_NUM_THREADS"] = "1"

import pytest
from hypothesis import HealthCheck, settings

settings.register_profile(
    "noack",
    deadline=None,
    derandomize=True,
    print_blob=True,
    suppress_health_check=[HealthCheck.too_slow],  # it reads the wall clock
)
settings.load_profile("noack")


@pytest.fixture
def content() -> dict[str, Any]:
    """A valid scenario as parsed TOML: the double integrator, with as little as is required."""
    return {
        "name": "small",
        "horizon_s": 1.0,
        "model": {"name": "double_integrator"},
        "plant": {"initial_state": [1.0, 0.0]},
        "trigger": {"beta": 0.5, "alpha_per_s": 0.25},
        "network": {"mansd": 2, "loss": {"model": "bernoulli", "probability": 0.5}},
    }
