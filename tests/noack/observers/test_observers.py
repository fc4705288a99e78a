"""Gains of observers, their estimates in whole loops with disturbances and noise, and the claims."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_lyapunov
from scipy.stats import chi2

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.replay import replay
from cosim.analysis.summary.loop_summary import summarise_loop
from cosim.record.align import align_tables, true_states
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from netem.core.row_operations import row_norms
from noack.observers.observer_settings import observer_gain, unobservable_mode
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.estimation import assumed_model, steady_state, true_model
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from tests.cosim.simulation.outage import LosingMachine, simulate_with
from tests.oracles.explained_run.explain import explains

NOISE = {"C": [[1.0, 0.0]], "noise_std": [0.02]}
KALMAN = {"kind": "kalman", "initial_std": [0.4, 0.4]}
GUSTS = {"kind": "gaussian", "std": [0.5]}


def estimation_error(record: RunRecord) -> NDArray[np.float64]:
    """x̂ − x at each measurement."""
    rows = record["sensor_measurement"]
    errors: NDArray[np.float64] = rows["x"] - true_states(record["plant_step"], rows["t_ns"])
    return errors


@pytest.fixture
def observed(content: dict[str, Any]) -> dict[str, Any]:
    """The double integrator with gusts, a noisy position measurement and a loss rate of ½."""
    content["plant"] |= {"rate_hz": 100.0, "measurement": NOISE, "disturbances": [GUSTS]}
    content["controller"] = {"rate_hz": 100.0}
    content["trigger"] |= {"beta": 0.1, "floor": 0.1}
    content["observer"] = KALMAN
    return content


def resolved(content: dict[str, Any], **seeds: int) -> Scenario:
    return resolve(validate(content | {"seeds": seeds}, "test"))


def run(content: dict[str, Any], **seeds: int) -> RunRecord:
    return simulate(resolved(content, **seeds))


def test_the_estimation_error_agrees_with_the_filters_covariance(observed: dict[str, Any]) -> None:
    """Over N runs Σ eᵀP⁻¹e is χ² with 2N degrees of freedom (Bar-Shalom, Li, Kirubarajan 2001)."""
    N, covariance = 80, steady_state(resolved(observed)).covariance
    ends = np.array([estimation_error(run(observed, disturbance=s, noise=s + 1000))[-1] for s in range(N)])
    distance = float(np.einsum("ki,ij,kj->", ends, np.linalg.inv(covariance), ends))
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 2 * N)
    assert low < distance < high
    # so an error that is 30 % off would be detected
    assert 2 * N / 1.3**2 < low < high < 2 * N * 1.3**2


@pytest.mark.parametrize("coupling", [1.0, 1e-3, 1e-6])
def test_the_covariance_is_that_of_its_equation_also_with_a_large_gain(
    observed: dict[str, Any], coupling: float
) -> None:
    """A state that hardly appears in the output needs one; P is then far from well conditioned."""
    observed["model"] = {"A": [[0.0, coupling], [0.0, 0.0]], "B": [[0.0], [1.0]],
                         "gain": [[-1.0 / coupling, -1.5]]}  # fmt: skip
    observed["observer"] = {"kind": "luenberger", "poles_per_s": [-5.0, -8.0]}
    scenario = resolved(observed)
    state, model = steady_state(scenario), true_model(scenario)
    A, Q = model.between_measurements()
    correction = np.eye(2) - state.gain @ model.C
    F, added = correction @ A, correction @ Q @ correction.T + state.gain @ model.R @ state.gain.T
    P = state.covariance
    scale = np.abs(F) @ np.abs(P) @ np.abs(F).T + np.abs(added)
    assert (np.abs(F @ P @ F.T + added - P) <= 1e-9 * scale).all()
    if coupling == 1.0:
        np.testing.assert_allclose(P, solve_discrete_lyapunov(F, added), rtol=1e-9)


def test_one_output_places_a_repeated_pole(observed: dict[str, Any]) -> None:
    observed["observer"] = {"kind": "luenberger", "poles_per_s": [-5.0, -5.0]}
    scenario = resolved(observed)
    loop, period_s = loop_of(scenario), scenario.timing.measurement_period_ns * 1e-9
    correction = np.eye(2) - steady_state(scenario).gain @ scenario.plant.measurement.matrix(2)
    closed = correction @ expm(loop.A_model * period_s)
    np.testing.assert_allclose(np.poly(closed), np.poly(np.full(2, np.exp(-5.0 * period_s))), atol=1e-9)


def test_measurements_that_are_lost_are_bridged_and_replayed(observed: dict[str, Any]) -> None:
    observed["plant"]["disturbances"] = [{"kind": "gaussian", "std": [1e-9]}]
    observed["plant"]["measurement"] = {"C": [[1.0, 0.0]], "noise_std": [1e-9]}
    scenario = resolved(observed)
    lost = {30, 31, 32, 33, 70}
    record = simulate_with(
        scenario, "sensor", lambda machine: LosingMachine(machine, lambda k: k not in lost)
    )
    assert len(record[SENSOR_MEASUREMENT]) == 101 - len(lost)
    assert replay(record).bit_exact
    # The input during the gap is unknown: it changes as the model decays.
    error = row_norms(estimation_error(record))
    moved = np.abs(np.diff(record[PLANT_STEP]["u"][:, 0])).max() * 4 * 0.04
    assert error[60:].max() < moved
    assert error[20:30].max() < 1e-6


@pytest.mark.parametrize("initial_sync", ["known_state", "first_packet"])
def test_the_first_measurement_has_its_own_gain_whatever_is_known(
    observed: dict[str, Any], initial_sync: str
) -> None:
    observed["observer"] = {
        "kind": "luenberger", "gain": [[0.5], [0.5]], "first_gain": [[1.0], [0.0]],
        "initial_estimate": [0.3, -0.2],
    }  # fmt: skip
    observed["network"] |= {"initial_sync": initial_sync}
    record = run(observed)
    rows = record["sensor_measurement"]
    np.testing.assert_allclose(rows["x"][0], [rows["y"][0, 0], -0.2], rtol=1e-12)
    assert not explains(record)


def test_i1_is_claimed_of_the_estimate(
    observed: dict[str, Any],
) -> None:
    observed["horizon_s"] = 4.0
    record = run(observed)
    claims = RunClaims(record)
    evaluated = claims.evaluate()
    assert {claim.source for claim in evaluated} == {"(I1)", "certificate", "network"}
    assert {claim.verdict for claim in evaluated if claim.source == "(I1)"} == {"held"}
    assert any("x_c − x̂" in claim.bound for claim in evaluated)
    # Relative to the plant's own state the claim of (I1) would not hold, so it is not claimed.
    joined = align_tables(record)
    e_c = row_norms(joined.x_c - true_states(record[PLANT_STEP], joined.t_ns))
    assert (e_c > joined.e_c_norm + 1e-6).any()
    assert (e_c <= joined.e_c_norm + row_norms(estimation_error(record)) + 1e-12).all()


def test_the_summary_contains_the_estimation_error(observed: dict[str, Any]) -> None:
    record = run(observed, disturbance=1, noise=2)
    estimation = summarise_loop(record, 0, "horizon").to_json()["estimation"]
    norms = np.linalg.norm(estimation_error(record), axis=1)
    assert estimation["max"] == pytest.approx(norms.max())
    assert estimation["rms"] == pytest.approx(np.sqrt((norms**2).mean()))
    assert (estimation["observer"], estimation["outputs"], estimation["noise_std"]) == ("kalman", 1, [0.02])
    assert estimation["expected_rms"] == pytest.approx(
        np.sqrt(np.trace(steady_state(record.scenario).covariance))
    )
    assert estimation["sup_e_c_norm"] > 0
    # Without an observer, noisy measurements are used as x.
    del observed["observer"]
    observed["plant"]["measurement"] = {"noise_std": [0.02, 0.05]}
    noisy = run(observed)
    sizes = estimation_error(noisy).std(axis=0)
    assert 0.01 < sizes[0] < 0.03 < sizes[1] < 0.08
    judged = RunClaims(noisy).evaluate()
    assert {claim.verdict for claim in judged if claim.source == "(I1)"} == {"held"}
    assert summarise_loop(noisy, 0, "horizon").to_json()["estimation"]["observer"] is None


def test_complex_poles_and_several_outputs_are_placed() -> None:
    Ad = expm(np.array([[0.0, 1, 0], [0, 0, 1], [1, -2, 0.5]]) * 0.01)
    wanted = (np.exp((-3 + 4j) * 0.01), np.exp((-3 - 4j) * 0.01), np.exp(-9 * 0.01 + 0j))
    for outputs in (np.eye(3)[:1], np.eye(3)[[0, 2]], np.eye(3)):
        L = observer_gain(Ad, outputs, wanted)
        poles = np.linalg.eigvals((np.eye(3) - L @ outputs) @ Ad)
        np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(wanted), atol=1e-7)


def test_an_unobservable_mode_is_reported_by_its_eigenvalue() -> None:
    Ad = np.diag([1.5, 0.5, 0.9])
    assert unobservable_mode(Ad, np.array([[1.0, 0.0, 0.0]])) is None
    assert unobservable_mode(Ad, np.array([[0.0, 1.0, 1.0]])) == 1.5
    assert unobservable_mode(Ad, np.array([[1.0, 1.0, 0.0]]), stable_too=True) == 0.9


def test_filter_settings_default_to_the_scenarios_noise_and_disturbances(observed: dict[str, Any]) -> None:
    observed["plant"]["disturbances"] = [
        {"kind": "gaussian", "at": "input", "std": [0.3]},
        {"kind": "uniform", "at": "state", "bound": [0.0, 0.6]},
        {"kind": "sine", "amplitude": [5.0], "hz": 1.0},
    ]
    scenario = resolved(observed)
    assumed, h = assumed_model(scenario), 0.01
    into = np.array([h**2 / 2, h])  # of the double integrator with a held input
    expected = (0.3**2 + 0.6**2 / 3) * np.outer(into, into)
    np.testing.assert_allclose(assumed.Q, expected, rtol=1e-9)
    assert assumed.R.tolist() == [[0.02**2]]
    observed["observer"] = KALMAN | {
        "process_std": [0.0, 0.0], "input_std": [1.0], "noise_std": [0.5],
    }  # fmt: skip
    given = assumed_model(resolved(observed))
    np.testing.assert_allclose(given.Q, np.outer(into, into), rtol=1e-9)
    assert given.R.tolist() == [[0.25]]
    np.testing.assert_allclose(true_model(resolved(observed)).Q, expected, rtol=1e-9)


def test_the_scalar_steady_state_solves_the_quadratic_equation(content: dict[str, Any]) -> None:
    """P⁻ = a²P⁻R/(P⁻ + R) + q, solved by hand."""
    a, h, r, q = 2.0, 0.01, 0.04, 9e-4
    content["model"] = {"A": [[a]], "B": [[1.0]], "gain": [[-3.0]]}
    content["plant"] = {
        "initial_state": [0.0], "rate_hz": 100.0,
        "measurement": {"noise_std": [0.2]},
    }  # fmt: skip
    content["observer"] = {"kind": "kalman", "Q": [[q]], "initial_std": [1.0]}
    content["plant"]["disturbances"] = [
        {"kind": "gaussian", "at": "state", "std": [np.sqrt(q) * a / np.expm1(a * h)]}
    ]
    f = np.exp(2 * a * h)
    b = r * (1 - f) - q
    before = (-b + np.sqrt(b**2 + 4 * q * r)) / 2
    steady = steady_state(resolved(content))
    assert steady.covariance[0, 0] == pytest.approx(before * r / (before + r), rel=1e-9)
    assert steady.gain[0, 0] == pytest.approx(before / (before + r), rel=1e-9)
    assert steady.radius == pytest.approx(np.exp(a * h) * r / (before + r), rel=1e-9)
