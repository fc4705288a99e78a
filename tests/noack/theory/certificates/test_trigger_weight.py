"""The chosen weight: in its norm the models contract, and the certificate is tighter."""

import numpy as np
import pytest

import noack
from noack.scenario.resolution import LoopMatrices, loop_of, resolve
from noack.theory.bounds.certificate_terms import Constants, NetworkConditions, TriggerBound
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.gains import ErrorGains, PlantGains
from noack.theory.certificates.solution import solve
from noack.theory.certificates.trigger_weight import choose_weight

BETA, ALPHA = 0.2, 0.1
CONDITIONS = NetworkConditions(1)


def certified(loop: LoopMatrices, weight: np.ndarray) -> Constants:
    models = ErrorGains(loop.H, loop.K, weight, ALPHA)
    plant = PlantGains(models, loop.A, loop.B, loop.x0[:, None], ALPHA)
    return solve(models, plant, CONDITIONS, TriggerBound(BETA, BETA))


def test_the_chosen_weight_contracts_the_models_and_tightens_the_certificate() -> None:
    loop = loop_of(resolve(noack.load("double_integrator")))
    weight = choose_weight(loop, BETA, ALPHA, CONDITIONS)
    # It encloses the same volume as the identity, and ‖e^{(H+αI)t}‖_W does not grow.
    assert abs(np.linalg.det(weight)) == pytest.approx(1.0)
    scaled = weight @ (loop.H + ALPHA * np.eye(loop.n)) @ np.linalg.inv(weight)
    assert np.linalg.eigvalsh(scaled + scaled.T)[-1] <= 1e-9
    chosen, identity = certified(loop, weight), certified(loop, np.eye(loop.n))
    assert chosen.inter_event_s is not None
    assert identity.inter_event_s is not None
    merit, other = (c.state / (c.inter_event_s or 0.0) ** 3 for c in (chosen, identity))
    assert merit < other


def test_a_threshold_that_decays_faster_than_the_models_has_no_weight() -> None:
    loop = loop_of(resolve(noack.load("double_integrator")))
    with pytest.raises(NotDecayingError, match="is not below the decay rate of the models"):
        choose_weight(loop, BETA, 10.0, CONDITIONS)
