"""Kalman filters: the gains that a scenario states, and documents that prove nothing."""

from collections.abc import Mapping
from itertools import islice

import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from cosim.analysis.witnesses import WitnessedStatement, find_statement
from cosim.simulation.virtual_time import simulate
from netem.core.core_library import reals_at
from netem.core.errors import CallerError
from noack.core.balls import number
from noack.core.core_library import core, pointer_to
from noack.core.linear_systems import Matrix
from noack.observers.kalman import KalmanSettings
from noack.observers.observer_settings import EstimationModel
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.scenario import read_loop
from noack.proof.statement_proof import prove_statement
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.estimation import assumed_model
from noack.scenario.resolution import resolve
from noack.settings.values import rows_of
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


def textbook_gains(A: Matrix, model: EstimationModel, std: Matrix, count: int) -> list[Matrix]:
    """Return the first gains of the filter, by its covariance before each measurement."""
    P, found = np.diag(np.square(std)), []
    for _ in range(count):
        L = P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + model.R)
        found.append(L)
        rest = np.eye(len(A)) - L @ model.C
        P = rest @ P @ rest.T + L @ model.R @ L.T
        for _ in range(model.steps):
            P = model.Ad @ P @ model.Ad.T + model.Q
    return found


@pytest.mark.parametrize("name", FILTERS)
def test_a_resolved_scenario_states_the_gains_that_the_filter_uses(name: str) -> None:
    resolved = first_loop(SCENARIO, *FILTERS[name])
    observer = resolved.observer
    assert isinstance(observer, KalmanSettings)
    assert observer.gains is not None
    stated, model = np.array(observer.gains), assumed_model(resolved)
    expected = textbook_gains(model.Ad, model, np.array(observer.initial_std), len(stated) + 400)
    largest = np.abs(stated).max()
    np.testing.assert_allclose(stated, expected[: len(stated)], rtol=1e-6, atol=1e-9 * largest)
    assert np.abs(stated[-1] - expected[-1]).max() < 1e-5 * largest
    of_loop = read_loop(tables_of(resolved), box=False, ideal=False).observer
    assert of_loop is not None
    assert [floats(gain).tolist() for gain in of_loop.gains] == stated.tolist()
    used = [*islice(observer.gains_of(model), len(stated) + 2)]
    assert np.array_equal(np.array(used), np.array([*stated, stated[-1], stated[-1]]))


def test_the_last_gain_is_the_steady_one() -> None:
    resolved = first_loop(SCENARIO)
    model = assumed_model(resolved)
    A, Q = model.between_measurements()
    P = solve_discrete_are(A.T, model.C.T, Q, model.R)
    L = P @ model.C.T @ np.linalg.inv(model.C @ P @ model.C.T + model.R)
    assert isinstance(resolved.observer, KalmanSettings)
    np.testing.assert_allclose(np.array(resolved.observer.gains)[-1], L, rtol=1e-5)


def test_the_sensor_uses_exactly_the_stated_gains() -> None:
    """Other gains within the tolerance give other estimates: the filter does not compute its own."""
    resolved = first_loop(SCENARIO, OFTEN)
    observer = resolved.observer
    assert isinstance(observer, KalmanSettings)
    moved = tuple(map(rows_of, np.array(observer.gains) * (1 + 5e-7)))
    other = resolved.model_copy(update={"observer": observer.model_copy(update={"gains": moved})})
    assert resolve(other).observer == other.observer
    for each in (resolved, other):
        gains = np.array(each.observer.gains)  # type: ignore[union-attr]
        run, model = simulate(each), assumed_model(each)
        measured, x_hat = run[SENSOR_MEASUREMENT], np.zeros(2)
        for k, row in enumerate(measured):
            for u in row["u_applied"].reshape(model.steps, -1) if k else ():
                x_hat = model.Ad @ x_hat + model.Bd @ u
            L = gains[min(k, len(gains) - 1)]
            x_hat = x_hat + L @ (row["y"] - model.C @ x_hat)
            assert np.abs(row["x"] - x_hat).max() < 1e-12
            x_hat = row["x"]


def test_after_a_missing_measurement_the_gain_follows_from_the_covariance() -> None:
    observer = KalmanSettings(
        kind="kalman", initial_std=(1.0,), Q=((1.0,),), R=((1.0,),), gains=(((0.5,),), ((0.6,),))
    )
    one = np.eye(1)
    core_observer = observer.observer(EstimationModel(one, one, one, one, one, one, 1), {})
    nothing = pointer_to(np.zeros(1), "double *")
    core.noack_observer_gain(core_observer)
    assert reals_at(core_observer.gain, 1)[0] == 0.5
    core.noack_observer_correct(core_observer, nothing)
    core.noack_observer_gain(core_observer)
    assert reals_at(core_observer.gain, 1)[0] == 0.6
    core_observer.has_gap = 1
    for _ in range(2):  # P is 0.5 after the first measurement
        core.noack_observer_predict(core_observer, nothing)
    core.noack_observer_gain(core_observer)
    assert reals_at(core_observer.gain, 1)[0] == pytest.approx(2.5 / 3.5)


# The scenario.


def test_other_gains_than_those_of_the_covariances_are_refused() -> None:
    resolved = first_loop(SCENARIO, OFTEN)
    assert resolve(resolved).observer == resolved.observer
    assert isinstance(resolved.observer, KalmanSettings)
    noisier = resolved.observer.model_copy(update={"initial_std": (0.3, 0.3)})
    with pytest.raises(CallerError, match=r"observer\.gains: not those that follow"):
        resolve(resolved.model_copy(update={"observer": noisier}))


def test_gains_that_do_not_become_constant_are_not_stated() -> None:
    """The gains of a constant that is measured fall as 1/k."""
    settings = (
        "horizon_s=1.0",
        'observer={kind="kalman",initial_std=[1.0,1.0],Q=[[0.0,0.0],[0.0,1e-300]],R=[[1.0]]}',
    )
    resolved = first_loop("double_integrator", "plant.measurement={C=[[1.0,0.0]],noise_std=[0.1]}", *settings)
    assert isinstance(resolved.observer, KalmanSettings)
    assert resolved.observer.gains is None


def test_a_filter_without_stated_gains_has_no_statement() -> None:
    tables = resolved_tables(SCENARIO)
    del tables["observer"]["gains"]
    with pytest.raises(RefusedError, match=r"^observer\.gains: missing"):
        read_loop(tables, box=False, ideal=False)


@pytest.mark.parametrize("gains", [[], [[[1.0]]], [[[1.0, 0.0], [1.0, 0.0]]], "1", [[["1"], [1.0]]]])
def test_what_is_no_list_of_gains_is_refused(gains: object) -> None:
    tables = resolved_tables(SCENARIO)
    tables["observer"]["gains"] = gains
    with pytest.raises(RefusedError, match="observer"):
        read_loop(tables, box=False, ideal=False)


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
    "a period 5 % longer": ("plant.rate_hz=95.23809523809524", "motion/0 lost/"),
    "less often measured": ("plant.measure_every=2", "motion/0 lost/"),
    "no filter": ('observer={kind="luenberger",poles_per_s=[-2.0,-2.5]}', "edge/0 lost, "),
}


@pytest.mark.parametrize("name", CHANGES)
def test_the_proof_of_another_filter_is_rejected(document: Document, name: str) -> None:
    setting, reason = CHANGES[name]
    tables = resolved_tables("double_integrator", *MASS, setting)
    loop = read_loop(tables, box=False, ideal=False)
    with pytest.raises(RejectedError, match=f"at ({reason})"):
        prove_statement(loop, completed(loop, document))


def test_another_gain_at_one_measurement_is_rejected(document: Document) -> None:
    loop = read_loop(resolved_tables("double_integrator", *MASS), box=False, ideal=False)
    assert loop.observer is not None
    for test in (0, len(loop.observer.gains) - 1):
        gains = [*loop.observer.gains]
        gains[test] = gains[test] * number(1.5)
        other = loop._replace(observer=loop.observer._replace(gains=tuple(gains)))
        with pytest.raises(RejectedError, match=r"at edge/"):
            prove_statement(other, completed(other, document))


def test_random_runs_of_the_loop_with_its_gains_stay_within_the_bounds() -> None:
    loop, proof = proved("filtered_mass").loop, proved("filtered_mass").proof
    for seed in range(2):
        assert exceeded(loop, proof, np.random.default_rng(seed), 4.0, by_forms=False) == []


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
