"""Inputs that were computed for a later time than the one at which they act: K e^{−Hs} x_c with s < 0."""

import numpy as np
import pytest
from flint import fmpq
from scipy.linalg import expm
from scipy.optimize import linprog

from noack.core.balls import number
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from noack.theory.witnesses.documents import find_witness
from tests.checker.completed import completed
from tests.checker.loops import double_integrator, loop_with, servo
from tests.checker.proofs import by_gains
from tests.checker.random_loops import random_loop
from tests.checker.runs import exceeded, floats

AGE, LEAD = fmpq(3, 100), fmpq(1, 10)


def leading(loop: Loop, lead: fmpq) -> Loop:
    return loop._replace(times=loop.times._replace(lead=lead))


def is_in_hull(loop: Loop, s: float) -> bool:
    """Whether K e^{−Hs} is a mean of the model's gains, to within 1e-9."""
    model = Model(loop, number(0.3), number(0.8))
    points = [floats(gain).ravel() for gain in model._gains()]
    aged = (floats(loop.gain) @ expm(-floats(loop.H) * s)).ravel()
    below = np.vstack([np.array(points).T, -np.array(points).T])
    limits = np.concatenate([aged + 1e-9, 1e-9 - aged])
    ones = np.ones((1, len(points)))
    return bool(linprog(0 * ones[0], below, limits, ones, [1.0]).success)


def test_all_ages_are_covered_and_no_others() -> None:
    loop = leading(double_integrator(), LEAD)
    ages = np.linspace(-float(LEAD.p) / float(LEAD.q), float(AGE.p) / float(AGE.q), 14)
    assert all(is_in_hull(loop, s) for s in ages)
    assert not is_in_hull(loop, -0.15)
    assert not is_in_hull(double_integrator(), -0.1)


@pytest.mark.parametrize("seed", [105, 108])
def test_no_run_with_leads_exceeds_the_bounds_of_either_proof(seed: int) -> None:
    loop = random_loop(np.random.default_rng(seed))
    loop = leading(loop, 20 * loop.times.sampling)
    until = 600 * float(loop.times.sampling.p) / float(loop.times.sampling.q)
    proofs: list[Proof] = [find_witness(loop).proof, by_gains(loop)[1]]
    for proof in proofs:
        for run in range(3):
            assert exceeded(loop, proof, np.random.default_rng(run), until) == []


def test_a_proof_of_ages_from_0_on_is_none_of_earlier_ones() -> None:
    loop = double_integrator()
    document = find_witness(loop).document
    prove_statement(loop, document)
    with pytest.raises(RejectedError, match="not proven at motion/"):
        prove_statement(leading(loop, fmpq(3, 10)), completed(leading(loop, fmpq(3, 10)), document))


def test_bounds_by_gains_grow_with_the_lead() -> None:
    sizes = [
        {b.output: float(b.decaying) + float(b.constant) for b in by_gains(leading(loop, lead))[1].bounds}
        for loop in [double_integrator()]
        for lead in (fmpq(0), LEAD, fmpq(2, 10))
    ]
    assert sizes[0]["x"] < sizes[1]["x"] < sizes[2]["x"]


def test_an_input_for_a_later_time_is_as_far_from_its_reference_as_an_older_one() -> None:
    """u_r(τ) − u_r(t) is as large for τ > t as for τ < t, and never are both added."""
    older, later, both = (
        floats(loop_with(servo(), **times).pushes)
        for times in (
            {"age": fmpq(28, 1000)},
            {"lead": fmpq(28, 1000)},
            {"age": AGE - fmpq(2, 1000), "lead": AGE},
        )
    )
    np.testing.assert_array_equal(older, later)
    assert np.abs(both[:, 0]) == pytest.approx(30 / 28 * np.abs(older[:, 0]), rel=1e-6)
