"""Bounded noise of measurements: what changes by it, and documents that leave it out somewhere."""

import numpy as np
import pytest
from flint import arb, fmpq

from noack.theory.witnesses.assumptions import first_event_s, inter_event_s
from noack_check.balls import matrix, number, zeros
from noack_check.check import RejectedError
from noack_check.keys import RefusedError
from noack_check.model import Chain, Errors, Model
from noack_check.norms import growth
from noack_check.proof import (
    Bound,
    Proof,
    _prove_quiet_start,
    error_without_input,
    prove,
    share_of_errors,
    weighted,
)
from noack_check.scenario import read_loop
from tests.checker.completed import completed
from tests.checker.loops import IDEAL, NOISY, SCHEDULE, double_integrator, early, noisy
from tests.checker.proofs import Proved, proved
from tests.checker.rejections import failing, rejects
from tests.checker.runs import exceeded, floats
from tests.helpers.resolved_tables import resolved_tables

SIZE = 0.003
LOOP = NOISY


@pytest.fixture(scope="module")
def witness() -> Proved:
    return proved("noisy")


def drift_of(proof: Proof) -> tuple[float, float]:
    bound = next(bound for bound in proof.bounds if bound.output == "drift")
    return float(bound.decaying.mid()), float(bound.constant.mid())


# The model.


def vectors(model: Model, z: np.ndarray) -> dict[str, np.ndarray]:
    names = {"x": model.x, "e": model.e, "w": model.w, "n": model.noise}
    found = {name: floats(rows) @ z for name, rows in names.items()}
    return found | {f"v{i}": floats(v) @ z for i, v in enumerate(model.v)}


@pytest.mark.parametrize("times", [SCHEDULE, IDEAL])
def test_an_event_sets_the_sensors_model_to_the_measurement_and_changes_no_prediction(times: object) -> None:
    """x_s := x + n, while x_c = x_s + w and the predictions x_s + v of updates on their way stay."""
    loop = noisy(double_integrator(times, floor=0.03))  # type: ignore[arg-type]
    model = Model(loop, number(0.1), number(0.5), later=2, later_at_start=2)
    rng, tested = np.random.default_rng(0), set()
    for edge in model.edges:
        z = rng.normal(size=model.size)
        before, after = vectors(model, z), vectors(model, floats(edge.jump) @ z)
        assert (before["x"] == after["x"]).all()
        if "event" in edge.name or edge.name.endswith(("lost, lost", "sent", "delivered")):
            tested.add(edge.name)
            assert after["e"] == pytest.approx(before["n"])
            moved = before["x"] + before["e"] - (after["x"] + after["e"])
            if not (edge.name.startswith("start") or "delivered" in edge.name):
                assert after["w"] == pytest.approx(before["w"] + moved)
            if "later, event" in edge.name and not edge.name.startswith("start"):
                k = int(edge.name[0])
                for i in range(k):
                    assert after[f"v{i}"] == pytest.approx(before[f"v{i}"] + moved)
                assert after[f"v{k}"] == pytest.approx(moved)
    assert len(tested) >= 3


def test_the_rule_compares_what_is_measured() -> None:
    loop = noisy(double_integrator(floor=0.03))
    loop = loop._replace(rule=loop.rule._replace(negative=matrix([[0.1, 0, 0, 0], [0, 0.1, 0, 0]])))
    model, rng = Model(loop, number(0.3), number(0.8)), np.random.default_rng(0)
    P, N = floats(loop.rule.positive), floats(loop.rule.negative)
    for _ in range(5):
        z = rng.normal(size=model.size)
        state = vectors(model, z)
        y, e = state["x"] + state["n"], state["x"] + state["e"] - (state["x"] + state["n"])
        left, right = (float(np.sum((M @ np.concatenate([y, e])) ** 2)) for M in (P, N))
        f1, f2 = z[-2:]
        silent = left - right - (0.05 * f1) ** 2 - (0.03 * f2) ** 2
        assert float(z @ floats(model.silent) @ z) == pytest.approx(silent)


def test_a_rule_that_was_silent_says_nothing_with_the_noise_of_the_next_test() -> None:
    """With tests at all times ‖W (e − n)‖ is at most the threshold, then at least: for different n."""
    loop = noisy(double_integrator(IDEAL, floor=0.03))
    model = Model(loop, number(0.3), number(0.8))
    silent = model.silent
    for edge in model.edges:
        assert edge.is_test
        assert all(fact != silent for fact in edge.facts)
    names = {name: item.scalars for item in model.common_inequalities() if "edge" in (name := item.name)}
    for scalars in names.values():
        assert sum(name.startswith("m/") for name, _ in scalars) == 2 + 2  # guards of two units, two sizes


def test_all_tests_fail_with_more_noise(witness: Proved) -> None:
    entry = next(e for e in witness.document["bounds"] if e["output"] == "x")
    assert not failing(LOOP, entry, 0.3)
    found = failing(noisy(LOOP, 4 * SIZE), entry, 0.3)
    for kind in ("0 lost, silent/1 0", "1 lost, silent/1 0", "0 lost, sent/1 0", "0 lost, lost/1 0"):
        assert f"edge/{kind}" in found
    assert "start" in failing(noisy(LOOP, 100 * SIZE), entry, 0.3)


def test_a_document_without_noise_proves_nothing_with_noise() -> None:
    loop = noisy(proved("without_noise").loop)
    document = completed(loop, proved("without_noise").document)
    rejects(loop, document, "^x: edge/0 lost, sent/")


@pytest.mark.parametrize("index", [0, 1])
def test_noise_of_one_state_needs_its_multiplier(index: int) -> None:
    rejects(LOOP, completed(LOOP, proved(f"noisy_{index}").document), "^x: edge/0 lost, sent/")


def test_the_error_at_the_start_is_any_noise() -> None:
    """e(0) = n for all p: the matrix of the start has a row for each of them."""
    item = Model(LOOP, number(0.3), number(0.8)).start_inequality()
    assert item.constant.nrows() == 3
    assert {name for name, _ in item.scalars if name.startswith("m/")} == {"m/start/0", "m/start/1"}


# What follows from the drift.


def test_the_sensor_error_between_tests_has_the_noise() -> None:
    """e_s is up to threshold + noise after a silent test; runs of an undamped error reach more than f."""
    loop, proof = proved("undamped_noisy").loop, proved("undamped_noisy").proof
    sensor = next(bound for bound in proof.bounds if bound.output == "e_s")
    quiet = proved("undamped").proof
    without = next(bound for bound in quiet.bounds if bound.output == "e_s")
    too_small = proof._replace(bounds=(without,), inter_event=None, first_event=None)
    assert sensor.constant > without.constant + number(0.014)
    assert any(exceeded(loop, too_small, np.random.default_rng(k), 30.0) for k in range(8))
    assert not exceeded(loop, proof, np.random.default_rng(0), 30.0)


def test_the_time_between_events_is_shorter_by_the_noise_of_two_measurements(witness: Proved) -> None:
    drift, rate = drift_of(witness.proof), witness.document["rate"]
    without = inter_event_s(LOOP._replace(noise=zeros(2, 0)), rate, drift)
    assert without > 1.2 * witness.document["inter_event_s"]
    rejects(LOOP, {**witness.document, "inter_event_s": without}, "^inter_event_s: an event may")
    once = inter_event_s(noisy(LOOP, SIZE / 2), rate, drift)
    rejects(LOOP, {**witness.document, "inter_event_s": once}, "^inter_event_s: an event may")


def test_without_a_floor_noise_makes_events_at_once() -> None:
    loop = noisy(double_integrator(level=0.05))
    assert inter_event_s(loop, 0.3, (0.1, 0.0)) == 0
    found = completed(loop, proved("double_integrator").document)
    rejects(loop, found, "^x: edge/0 lost, sent/")


def test_the_first_event_may_come_earlier_by_noise() -> None:
    loop = early(0.05)
    loop = loop._replace(rule=loop.rule._replace(floor=arb(0.03)))
    found = proved("early_noisy")
    without = first_event_s(loop, drift_of(found.proof), 2 * found.document["inter_event_s"])
    assert without > found.document["first_event_s"]
    rejects(noisy(loop), {**found.document, "first_event_s": without}, "^first_event_s: an event may")


def test_a_start_is_quiet_up_to_the_noise_of_two_measurements() -> None:
    loop = double_integrator(SCHEDULE._replace(start=fmpq(3, 100)), level=0.0)
    grown = error_without_input(loop, fmpq(2, 100))
    for size, is_quiet in ((0.0, True), (0.004, True), (0.0055, False)):
        rule = loop.rule._replace(floor=arb((grown + 0.015).mid()))
        tried = noisy(loop._replace(rule=rule), size)
        if is_quiet:
            _prove_quiet_start(tried)
        else:
            with pytest.raises(RejectedError, match="an event may happen"):
                _prove_quiet_start(tried)


# What is assumed of the errors, and the chain.


def test_the_chain_has_the_noise_of_each_missing_event(witness: Proved) -> None:
    document = {key: value for key, value in witness.document.items() if key != "gains"}
    bounds = {bound.output: bound for bound in prove(LOOP, document).bounds}
    gain = witness.document["chain"]["gain"]
    constant, size = float(bounds["e_s"].constant.mid()), SIZE * 2**0.5
    recent = float(growth(weighted(LOOP, witness.proof.rate), arb(LOOP.times.delay))[0])
    missing = 2 * gain + recent
    by_chain = constant + missing * (constant + size)
    assert float(bounds["e_c"].constant.mid()) == pytest.approx(by_chain)


def test_errors_are_assumed_with_the_noise(witness: Proved) -> None:
    sensor = {bound.output: bound for bound in witness.proof.bounds}["e_s"]
    sizes = {name: float(getattr(sensor, name).mid()) for name in ("decaying", "constant")}
    most = max(1.0, sizes["decaying"] / sizes["constant"])
    with_noise = {name: size * 3 + most * SIZE * 2**0.5 for name, size in sizes.items()}
    document = completed(LOOP, {**witness.document, "errors": sizes}, whole=True)
    rejects(LOOP, document, "^errors: the sensor's error may exceed them")
    decaying, constant = drift_of(witness.proof)
    drift = Bound("drift", number(decaying), number(constant), True)
    assumed = Errors(number(with_noise["decaying"]), number(with_noise["constant"]), Chain(arb(1), arb(1)))
    loops = LOOP, LOOP._replace(noise=zeros(2, 0))
    shares = [float(share_of_errors(loop, number(0.3), drift, assumed).mid()) for loop in loops]
    # The noise twice: within e_s after a test, and at the next one.
    assert shares[0] - shares[1] >= 2 * SIZE * 2**0.5 / with_noise["constant"]


# The scenario.


def test_bounded_noise_is_read() -> None:
    tables = resolved_tables("double_integrator", "plant.measurement.noise_bound=[0.01, 0.0]")
    loop = read_loop(tables, box=False, ideal=False)
    assert loop.noise == matrix([[0.01], [0.0]])
    assert float(loop.plain_noise.sizes[1].mid()) == pytest.approx(0.01)


@pytest.mark.parametrize("value", [[0.1], [0.1, -0.1], [0.1, "1"], 0.1, [float("nan"), 0.0]])
def test_noise_has_a_bound_for_each_state(value: object) -> None:
    tables = resolved_tables("double_integrator")
    plant = tables["plant"] | {"measurement": {"noise_bound": value}}
    with pytest.raises(RefusedError, match=r"plant\.measurement\.noise_bound"):
        read_loop(tables | {"plant": plant}, box=False, ideal=False)


def test_noise_is_refused_if_the_start_is_known() -> None:
    """The measurement at t = 0 may then be an event, before the first input acts."""
    tables = resolved_tables(
        "double_integrator", "plant.measurement.noise_bound=[0.01, 0.0]", "network.initial_sync=known_state"
    )
    with pytest.raises(RefusedError, match='known_state": not covered with noise'):
        read_loop(tables, box=False, ideal=False)


def test_forms_that_do_not_change_between_tests_need_no_silent_edges() -> None:
    """With a deadline and an assumed error they have one node: a silent test leaves V as it is."""
    loop = noisy(double_integrator(floor=0.03))
    loop = loop._replace(rule=loop.rule._replace(always=True))
    errors = Errors(arb(1), arb(1), Chain(arb(2), arb(2)))
    model = Model(loop, number(0.3), number(0.8), errors)
    assert len(model.locations[0].nodes) == 1
    names = {item.name for item in model.inequalities("x", starts=True)}
    assert names
    assert not any("silent" in name for name in names)
