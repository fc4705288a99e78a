"""Witnesses with an assumed size of the sensor's error, between tests and while updates are on their way."""

import numpy as np
import pytest
from flint import arb, fmpq
from scipy.linalg import expm

from noack.proof.statement_proof import prove_statement
from noack_check.balls import identity, matrix, number
from noack_check.check import RejectedError
from noack_check.model import Chain, Errors, Model
from noack_check.proof import error_without_input
from tests.checker.completed import completed
from tests.checker.loops import ASSUMED, SCHEDULE, bounds_of, changed, double_integrator
from tests.checker.proofs import Proved, proved
from tests.checker.runs import exceeded, floats


@pytest.fixture(scope="module", params=ASSUMED)
def found(request: pytest.FixtureRequest) -> Proved:
    return proved(request.param)


def test_runs_under_the_schedule_stay_below_the_bounds(found: Proved) -> None:
    assert 1.0 <= bounds_of(found.proof)["x"] < 1.8
    for seed in range(6):
        assert not exceeded(found.loop, found.proof, np.random.default_rng(seed), 4.0)


@pytest.mark.parametrize("share", [0.5, 0.97])
def test_errors_below_those_that_are_proven_are_rejected(found: Proved, share: float) -> None:
    sensor = next(bound for bound in found.proof.bounds if bound.output == "e_s")
    errors = {name: share * float(getattr(sensor, name)) for name in ("decaying", "constant")}
    with pytest.raises(RejectedError, match="errors: the sensor's error may exceed them"):
        prove_statement(found.loop, {**found.document, "errors": errors})


def test_larger_errors_are_not_covered_by_the_same_forms(found: Proved) -> None:
    larger = {name: 1.5 * size for name, size in found.document["errors"].items()}
    with pytest.raises(RejectedError, match=r"^x: flow/0 lost/"):
        prove_statement(found.loop, {**found.document, "errors": larger})


@pytest.mark.parametrize("change", ["slower tests", "later updates", "more losses", "another plant"])
def test_a_witness_proves_nothing_about_another_loop(found: Proved, change: str) -> None:
    loop, times = found.loop, found.loop.times
    other = {
        "slower tests": changed(loop, sampling=3 * times.sampling, least_sampling=3 * times.sampling),
        "later updates": changed(loop, delay=times.delay + fmpq(1, 50)),
        "more losses": loop._replace(losses=loop.losses + 2),
        "another plant": loop._replace(B=2 * loop.B),
    }[change]
    reason = {
        "slower tests": "x: flow/1 lost/|inter_event_s: an event may|errors: the sensor's error may",
        "later updates": "x: flow/0 later/",
        "more losses": "x: flow/3 lost/",
        "another plant": "x: flow/0 lost/",
    }[change]
    with pytest.raises(RejectedError, match=f"^({reason})"):
        prove_statement(other, completed(other, found.document, whole=True))


def test_facts_about_errors_bound_those_of_each_location() -> None:
    """Lost updates may be of any age, those on their way are at most as old as their delay."""
    loop = double_integrator()
    errors = Errors(number(0.5), arb(0), Chain(number(7.0), number(1.25)))
    model = Model(loop, number(0.3), number(1.0), errors, later=1)
    sizes = {}
    for place in model.locations:
        E = floats(identity(model.size))
        size = {"e": [], "w": []}  # type: dict[str, list[float]]
        for fact in map(floats, place.facts):
            name = "e" if fact[2, 2] else "w"
            assert np.allclose(fact, fact.T)
            assert np.allclose(np.diag(fact)[: len(E) - 2].sum(), loop.n)
            size[name].append(np.sqrt(-fact[-2, -2]) / 0.5)
        sizes[place.name] = size
    assert sizes == {
        "0 lost": {"e": [1.0], "w": []},
        "1 lost": {"e": [1.0], "w": [pytest.approx(7.0)]},
        "2 lost": {"e": [1.0], "w": [pytest.approx(14.0)]},
        "0 later": {"e": [1.0], "w": [pytest.approx(15.25)]},
        "1 later": {"e": [1.0], "w": [pytest.approx(16.5)]},
        "start, 0 later": {"e": [], "w": []},
    }


def test_without_an_input_the_error_of_plants_that_vary_in_time_is_bounded() -> None:
    """Entries of equations depend on x; here they jump between their limits, as a random run has it."""
    loop = double_integrator(SCHEDULE)._replace(half_A=matrix([[0.3, 0.3], [0.3, 0.3]]))
    bound = float(error_without_input(loop, fmpq(2)).mid())
    A, H, x_0 = floats(loop.A), floats(loop.H), floats(loop.start)[:, 0]
    rng, largest = np.random.default_rng(0), 0.0
    for _ in range(200):
        z = np.concatenate([x_0, x_0])
        for _ in range(40):
            F = A + 0.3 * rng.choice([-1.0, 1.0], (2, 2))
            z = expm(0.05 * np.block([[F, 0 * F], [0 * F, H]])) @ z
            largest = max(largest, float(np.linalg.norm(z[2:] - z[:2])))
    assert 0.1 * bound < largest < bound
    with pytest.raises(RejectedError, match="no bound of x"):
        error_without_input(loop._replace(half_A=matrix([[500.0, 500.0], [500.0, 500.0]])), fmpq(2))
