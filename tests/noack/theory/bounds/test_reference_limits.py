"""Limits of references against dense samples, and certificates about a reference against runs."""

import numpy as np
import pytest

from cosim.analysis.certificates import Certificates
from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.output.guarantee_sentence import guarantee_sentence
from cosim.simulation.virtual_time import simulate
from noack.core.references import Reference, ReferenceSegment
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.bounds.reference_limits import ReferenceLimits
from noack.theory.certificates.conditions import about_reference
from noack.theory.certificates.refusals import refusals_about_reference
from tests.helpers.shipped import resolved

S = 10**9


def servo(*settings: str) -> Scenario:
    return resolved("servo_reference", *settings)


def samples(scenario: Scenario) -> np.ndarray:
    reference = loop_of(scenario).reference
    assert reference is not None
    t_ns = np.arange(0, scenario.timing.horizon_ns, S // 1000)
    return reference.rows(t_ns)


def test_limits_are_those_of_dense_samples() -> None:
    scenario = servo()
    reference, rows = loop_of(scenario).reference, samples(scenario)
    assert reference is not None
    limits = ReferenceLimits(reference, scenario.timing.horizon_ns)
    largest = np.abs(rows).max(axis=0)
    assert limits.jump_s is None
    assert (largest <= limits.largest(np.eye(3)) * (1 + 1e-9)).all()
    assert limits.largest(np.eye(3)) == pytest.approx(largest, rel=0.05)
    change = np.abs(rows[7:] - rows[:-7]).max(axis=0)
    assert (change <= limits.largest_change(0.007) * (1 + 1e-9)).all()
    assert limits.largest_change(0.007) == pytest.approx(change, rel=0.1)
    assert not limits.residual(*scenario.model.matrices).any()


def test_jumps_and_steps_of_the_input_are_seen() -> None:
    def part(begin_s: int, x: float, u: float) -> ReferenceSegment:
        nothing = np.zeros((0, 2))
        return ReferenceSegment(begin_s * S, np.array([[x, u]]), np.zeros(0), nothing, nothing)

    parts = [part(0, 0.0, 0.0), part(1, 0.0, 2.0), part(2, 0.0, 3.0), part(3, 1.0, 3.0), part(4, 9.0, 9.0)]
    limits = ReferenceLimits(Reference(parts, 1), 5 * S)
    assert limits.jump_s == 3.0
    assert limits.largest_change(0.5).tolist() == [0.0, 2.0]
    assert limits.largest_change(1.5).tolist() == [0.0, 3.0]
    assert limits.is_at_rest_until(1.0)
    assert not limits.is_at_rest_until(1.1)
    assert limits.largest(np.eye(2)).tolist() == [0.0, 3.0]


def test_the_bounded_disturbances_contain_what_disturbs_the_deviation() -> None:
    """ẋ̃ − Ax̃ − B ũ for a plant at the edge of its box, with inputs as old as they may be."""
    scenario = servo()
    loop, rows = loop_of(scenario), samples(scenario)
    held, mismatch = about_reference(scenario, 2).plant.disturbances
    late = np.abs(rows[7:, 2:] - rows[:-7, 2:]).max(axis=0)
    assert held.at == "input"
    assert (late <= np.array(held.entries)).all()
    B = loop.B_model + np.array(scenario.plant.uncertainty_B)
    apart = rows @ np.hstack([loop.A_model - loop.A_model, B - loop.B_model]).T
    assert mismatch.at == "state"
    assert (np.abs(apart).max(axis=0) <= np.array(mismatch.entries) * (1 + 1e-9)).all()


def test_the_sentence_names_the_reference_and_its_first_jump() -> None:
    text = guarantee_sentence(Certificates(servo(), 2))
    assert text is not None
    assert text.startswith("angle stays within 0.15 rad of its reference from ")
    jumps = servo("controller.reference.1.join_s=0.0")
    until = guarantee_sentence(Certificates(jumps, 2))
    assert until is not None
    assert ", until the reference jumps at 4 s, although" in until


@pytest.mark.parametrize("seed", range(6))
def test_no_run_leaves_the_bounds(seed: int) -> None:
    """Half of the updates are lost; the plant is a vertex of its box."""
    draws = (f"seeds.loss={seed}", f"seeds.plant={seed}", 'plant.draw="vertex"', "certificate.prove=false")
    claims = RunClaims(simulate(servo(*draws))).evaluate()
    about_angle = [claim for claim in claims if claim.bound.startswith("|angle − r|")]
    assert {claim.verdict for claim in claims} == {"held"}
    assert len(about_angle) >= 2


def test_a_reference_that_begins_at_once_has_no_certificate() -> None:
    early = servo("controller.reference.0.from_s=0.0")
    assert len(refusals_about_reference(early)) == 2
    assert "begin the first piece after 0.006 s" in next(iter(refusals_about_reference(early).values()))
