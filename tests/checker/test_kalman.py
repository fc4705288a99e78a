"""Kalman filters: balls of their gains, the loops that they are for, and documents that prove nothing."""

from collections.abc import Mapping
from fractions import Fraction
from itertools import islice, repeat
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat
from scipy.linalg import expm, solve_discrete_are

from cosim.analysis.witnesses import WitnessedStatement, find_statement
from cosim.simulation.virtual_time import simulate
from noack.observers.kalman import KalmanSettings
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.estimation import assumed_model
from noack.scenario.resolution import resolve
from noack.theory.certificates.conditions import with_stated_numbers
from noack_check.balls import identity, matrix, number, zeros
from noack_check.check import RejectedError
from noack_check.kalman import ROUNDED, KalmanFilter
from noack_check.keys import RefusedError
from noack_check.proof import prove
from noack_check.scenario import read_loop
from tests.checker.completed import completed
from tests.checker.loops import FILTERED_MASS
from tests.checker.proofs import proved
from tests.checker.runs import exceeded, floats
from tests.helpers.bound_shares import share_of_bound
from tests.helpers.resolved_tables import first_loop, resolved_tables, tables_of
from tests.helpers.shipped import shipped

SCENARIO = "pendulum_observed"
Document = Mapping[str, object]
OFTEN = "plant.measure_every=5"
"""Fewer measurements until the gains are nearly constant."""

# The gains.

FILTERS = {
    "shipped": (),
    "measured every 50 ms": ("plant.measure_every=25", "observer.initial_std=[0.1,3.0]"),
    "a sudden first gain": (
        'observer={kind="kalman",initial_std=[100.0,100.0],noise_std=[1e-5],input_std=[3.0]}',
    ),
    "a known start": ('observer={kind="kalman",initial_std=[0.0,0.0],process_std=[0.1,1.0]}', OFTEN),
    "two outputs": ("plant.measurement={C=[[1.0,0.0],[1.0,2.0]],noise_std=[0.002,0.1]}", OFTEN),
    "given covariances": (
        'observer={kind="kalman",initial_std=[1.0,1.0],Q=[[1e-6,2e-7],[2e-7,1e-5]],R=[[1e-5]]}',
        OFTEN,
    ),
}


@pytest.mark.parametrize("name", FILTERS)
def test_the_gains_that_noack_runs_with_are_in_the_balls(name: str) -> None:
    resolved = first_loop(SCENARIO, *FILTERS[name])
    assert resolved.observer is not None
    observer = read_loop(tables_of(resolved), box=False, ideal=False).observer
    assert observer is not None
    balls, own = observer.gains, resolved.observer.gains(assumed_model(resolved))
    largest = 0.0
    for test, gain in enumerate(islice(own, 3 * len(balls))):
        for ball, value in zip(balls[min(test, len(balls) - 1)].entries(), gain.ravel(), strict=True):
            assert ball.contains(arb(float(value)))
            if test < len(balls) - 1 and ball.rad() > 0:
                largest = max(largest, abs(float(arb(float(value)) - ball.mid())) / float(ball.rad()))
    assert largest < 0.1  # the room for rounding is ample
    assert len(balls) > 3


def test_the_last_ball_has_the_steady_gain() -> None:
    resolved = first_loop(SCENARIO)
    model = assumed_model(resolved)
    A, Q = model.between_measurements()
    P = solve_discrete_are(A.T, model.C.T, Q, model.R)
    L = P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + model.R)
    observer = read_loop(tables_of(resolved), box=False, ideal=False).observer
    assert observer is not None
    for ball, value in zip(observer.gains[-1].entries(), L.ravel(), strict=True):
        assert ball.contains(arb(float(value)))
        assert ball.rad() < 1e-5


def test_balls_contain_the_exact_gains_of_a_scalar_filter() -> None:
    """P ← a²P r/(P + r) + q, in exact fractions."""
    a, q, r, P = Fraction(5, 4), Fraction(1, 8), Fraction(1, 2), Fraction(3)
    one = [[number(value)] for value in (a, q, r, P)]
    flow, added, R, start = (arb_mat([row]) for row in one)
    balls = KalmanFilter(flow, added, 1, identity(1), R, start).gains()
    for test in range(8):
        exact = P / (P + r)
        ball = balls[min(test, len(balls) - 1)][0, 0]
        assert ball.contains(number(exact))
        P = a * a * P * r / (P + r) + q
    assert balls[0][0, 0].rad() < 2 * ROUNDED


def test_steps_of_the_plant_add_up() -> None:
    """With k steps to a measurement, the gains are those of one step k times as long."""
    flow, added = matrix([[1.0, 0.125], [0.0, 1.0]]), matrix([[0.25, 0.0], [0.0, 0.5]])
    C, R, start = matrix([[1.0, 0.0]]), matrix([[1.0]]), identity(2)
    whole, power, Q = zeros(2, 2), identity(2), added
    for _ in range(3):
        whole, power = whole + power * Q * power.transpose(), flow * power
    pairs = zip(
        KalmanFilter(flow, added, 3, C, R, start).gains(),
        KalmanFilter(power, whole, 1, C, R, start).gains(),
        strict=True,
    )
    assert all(one.overlaps(other) for one, other in pairs)


@pytest.mark.parametrize(
    ("flow", "added", "R", "message"),
    [
        (1.0, 0.0, 1.0, "constant after 1000"),  # the gains fall as 1/k
        (1.5, -1.0, 1e-3, "positive definite"),
        (1.0, 1.0, -1.0, "positive definite"),
        (float("inf"), 1.0, 1.0, "constant|definite"),
    ],
)
def test_filters_without_a_constant_gain_are_refused(
    flow: float, added: float, R: float, message: str
) -> None:
    one = [matrix([[value]]) for value in (flow, added, R, 1e-3 if R < 0 else 0.5)]
    with pytest.raises(RefusedError, match=message):
        KalmanFilter(one[0], one[1], 1, identity(1), one[2], one[3]).gains()


# The scenario.


def test_the_stated_covariances_are_those_of_the_scenario() -> None:
    resolved = first_loop(SCENARIO, OFTEN)
    stated = with_stated_numbers(resolved)
    assert with_stated_numbers(stated).observer == stated.observer
    assert resolved.observer is not None
    assert stated.observer is not None
    pairs = zip(
        resolved.observer.gains(assumed_model(resolved)),
        stated.observer.gains(assumed_model(stated)),
        strict=False,
    )
    for first, second in islice(pairs, 50):
        np.testing.assert_allclose(first, second, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("change", [{"Q": [[1.0]]}, {"R": [[1.0, 0.0], [0.0, 1.0]]}, {"initial_std": [1.0]},
                                    {"Q": None}, {"R": "1"}, {"input_std": [0.2]}])  # fmt: skip
def test_what_is_no_filter_is_refused(change: dict[str, Any]) -> None:
    tables = resolved_tables(SCENARIO)
    tables["observer"] |= change
    with pytest.raises(RefusedError, match=rf"observer\.{next(iter(change))}"):
        read_loop(tables, box=False, ideal=False)


@pytest.mark.parametrize("key", ["Q", "R"])
def test_a_covariance_that_is_not_symmetric_is_refused(key: str) -> None:
    """The filter's gains would be those of another matrix than the scenario's."""
    tables = resolved_tables(SCENARIO, "plant.measurement={C=[[1.0,0.0],[1.0,2.0]],noise_std=[0.002,0.1]}")
    M = tables["observer"][key]
    M[0][1] += 1e-12
    with pytest.raises(RefusedError, match=rf"observer\.{key}: not symmetric"):
        read_loop(tables, box=False, ideal=False)
    M[1][0] += 1e-12
    M[0][1] = M[1][0]
    assert read_loop(tables, box=False, ideal=False).observer is not None


# Documents and runs.


@pytest.fixture(scope="module")
def statement() -> WitnessedStatement:
    return find_statement(first_loop(SCENARIO, OFTEN), "own", "schedule", most_work=0)


def test_the_pendulum_has_proven_bounds(statement: WitnessedStatement) -> None:
    assert statement.bounds is not None
    assert {"x", "y[0]", "e_s", "e_c", "estimate"} <= statement.bounds.bounds.keys()
    assert statement.bounds.bounds["estimate"].constant < 1.0


# Its bounds are those by gains, which the checker derives by itself. Quadratic forms are of one loop only.

MASS = FILTERED_MASS


@pytest.fixture(scope="module")
def document() -> Document:
    return proved("filtered_mass").document


CHANGES = {
    "the noise of the measurements + 5 %": ("plant.measurement.noise_bound=[0.000525]", "edge/0 lost, "),
    "a less noisy output for the filter": ("observer.noise_std=[0.005]", "edge/0 lost, "),
    "noisier inputs for the filter": ("observer.process_std=[0.0,4.0]", "edge/0 lost, "),
    "another first covariance": ("observer.initial_std=[0.2,1.0]", "edge/0 lost, "),
    "another first estimate": ("observer.initial_estimate=[0.98,0.01]", "edge/0 lost, "),
    "a period 5 % longer": ("plant.rate_hz=95.23809523809524", "flow/0 lost/"),
    "less often measured": ("plant.measure_every=2", "flow/0 lost/"),
    "no filter": ('observer={kind="luenberger",poles_per_s=[-2.0,-2.5]}', "edge/0 lost, "),
}


@pytest.mark.parametrize("name", CHANGES)
def test_the_proof_of_another_filter_is_rejected(document: Document, name: str) -> None:
    setting, reason = CHANGES[name]
    tables = resolved_tables("double_integrator", *MASS, setting)
    loop = read_loop(tables, box=False, ideal=False)
    with pytest.raises(RejectedError, match=f"^x: {reason}"):
        prove(loop, completed(loop, document))


def test_another_gain_at_one_measurement_is_rejected(document: Document) -> None:
    loop = read_loop(resolved_tables("double_integrator", *MASS), box=False, ideal=False)
    assert loop.observer is not None
    assert prove(loop, document).bounds
    for test in (0, 3, len(loop.observer.gains) - 1):
        gains = [*loop.observer.gains]
        gains[test] = gains[test] * number(1.5)
        other = loop._replace(observer=loop.observer._replace(gains=tuple(gains)))
        with pytest.raises(RejectedError, match=r"^x: edge/"):
            prove(other, completed(other, document))


def test_random_runs_of_the_loop_with_its_gains_stay_within_the_bounds(document: Document) -> None:
    loop = read_loop(resolved_tables("double_integrator", *MASS), box=False, ideal=False)
    proof = prove(loop, document)
    for seed in range(4):
        assert exceeded(loop, proof, np.random.default_rng(seed), 4.0, by_forms=False) == []


def test_gains_that_rounding_moves_have_no_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(KalmanSettings, "gains", lambda *_: repeat(np.array([[0.5], [0.5]])))
    found = find_statement(first_loop(SCENARIO, OFTEN), "own", "schedule", most_work=0)
    assert found.document is None
    assert found.reason.startswith("observer: rounding moves its gain at measurement 0")


def test_no_simulated_run_exceeds_the_bounds(statement: WitnessedStatement) -> None:
    """The runs are those of noack's machines, of which the checker has nothing."""
    assert statement.bounds is not None
    largest = 0.0
    for seed in range(4):
        settings = (f"seeds.{key}={seed}" for key in ("loss", "disturbance", "noise"))
        loss = f"network.loss.probability={0.3 + 0.1 * seed}"
        run = simulate(resolve(shipped(SCENARIO, OFTEN, loss, "horizon_s=4.0", *settings)))
        plant, measured = run[PLANT_STEP], run[SENSOR_MEASUREMENT]
        t_ns = measured["t_ns"]
        x = plant["x"][np.searchsorted(plant["t_ns"], t_ns)]
        for name, rows in (("x", x), ("estimate", measured["x"] - x)):
            largest = max(largest, share_of_bound(statement.bounds, name, t_ns, rows))
    assert 0.05 < largest <= 1.0


def test_the_worst_noise_comes_near_the_bound_of_the_error(statement: WitnessedStatement) -> None:
    loop = read_loop(resolved_tables(SCENARIO, OFTEN), box=False, ideal=False)
    assert loop.observer is not None
    assert statement.bounds is not None
    L, C = floats(loop.observer.gains[-1]), floats(loop.observer.outputs)
    T = float(loop.observer.period.p) / float(loop.observer.period.q)
    A, within = floats(loop.A), np.eye(2) - L @ C
    F, noise = within @ expm(A * T), float(loop.noise[0, 0].mid())
    steps = [expm(A * s) @ floats(loop.pushes) * T / 20 for s in (np.arange(20) + 0.5) * T / 20]
    sources = [L * noise, *(within @ step for step in steps)]
    powers = [np.linalg.matrix_power(F, k) for k in range(300)]
    reached = sum(np.abs((power @ source)[1]).sum() for power in powers for source in sources)
    bound = statement.bounds.bounds["estimate"].constant
    assert 0.8 * bound < reached <= bound
