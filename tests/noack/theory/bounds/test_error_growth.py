"""The time that e_s needs to a threshold, where it is known."""

import math

import numpy as np
import pytest

from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.bounds.error_growth import first_passage_s
from noack.theory.bounds.gains import PlantGains
from tests.noack.theory.certificates.certified_loops import certify_loop, gains_of
from tests.oracles.lossy_loops import System


def passage_s(
    plant: PlantGains, level: float, mismatch: float, input_error: float, error_gain: float
) -> float:
    """The first passage from 0."""
    return first_passage_s(
        plant, level=level, mismatch=mismatch, input_error=input_error, error_gain=error_gain, start=0.0
    )


def test_without_mismatch_or_push_the_threshold_is_never_reached() -> None:
    system = System(
        A=np.array([[-2.0]]), B=np.array([[1.0]]), K=np.array([[0.0]]), H=np.array([[-2.0]]),
        weight=np.eye(1), x0=np.ones(1), alpha=1.0, beta=0.1, known_start=True, mansd=0,
        step_s=0.01, sample_steps=1, delay_steps=0, hold_steps=0, lag_steps=0,
    )  # fmt: skip
    plant = gains_of(system)
    assert passage_s(plant, 0.1, 0.0, 0.0, 0.0) >= 1e6
    constants = certify_loop(system, NetworkConditions(0))
    assert constants.inter_event_s is not None
    assert constants.inter_event_s >= 1e6
    # ρ = π'(1 − e^{−t}): never above π', and half of it at ln 2.
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) == pytest.approx(math.log(2), rel=0.01)
    assert passage_s(plant, 0.5, 0.0, 1.0, 0.0) <= math.log(2)
    assert passage_s(plant, 1.01, 0.0, 1.0, 0.0) > 4
