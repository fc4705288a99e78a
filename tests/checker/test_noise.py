"""Bounded noise of measurements: what changes by it, and documents that leave it out somewhere."""

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from noack.core.balls import matrix, number, zeros
from noack.proof.elaborate.errors import RefusedError
from noack.proof.elaborate.hybrid_system import Errors, Model
from noack.proof.elaborate.scenario import read_loop
from noack.proof.event_times import levels_of
from noack.proof.files import proof_files
from noack.proof.loop_document import Naming
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_by_forms
from noack.theory.witnesses.assumptions import inter_event_s
from noack_kernel import RejectedError as RejectedByKernelError
from noack_kernel import prove
from tests.checker.completed import completed
from tests.checker.loops import IDEAL, NOISY, SCHEDULE, double_integrator, noisy, with_rule
from tests.checker.proofs import Proved, proved
from tests.checker.quiet_starts import is_quiet
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
    rejects(loop, document, "at edge/0 lost, sent/")


@pytest.mark.parametrize("index", [0, 1])
def test_noise_of_one_state_needs_its_multiplier(index: int) -> None:
    rejects(LOOP, completed(LOOP, proved(f"noisy_{index}").document), "at edge/0 lost, sent/")


def test_the_error_at_the_start_is_any_noise() -> None:
    """e(0) = n for all p: the matrix of the start has a row for each of them."""
    item = Model(LOOP, number(0.3), number(0.8)).start_inequality()
    assert item.constant.nrows() == 3
    assert {name for name, _ in item.scalars if name.startswith("m/")} == {"m/start/0", "m/start/1"}


# Errors, and times between events.


def test_the_sensor_error_between_tests_has_the_noise() -> None:
    """e_s is up to threshold + noise after a silent test; runs of an undamped error reach more than f."""
    loop, proof = proved("undamped_noisy").loop, proved("undamped_noisy").proof
    sensor = next(bound for bound in proof.bounds if bound.output == "e_s")
    quiet = proved("undamped").proof
    without = next(bound for bound in quiet.bounds if bound.output == "e_s")
    too_small = proof._replace(bounds=(without,), inter_event=None, first_event=None)
    assert sensor.constant > without.constant + number(0.013)
    assert any(exceeded(loop, too_small, np.random.default_rng(k), 30.0) for k in range(8))
    assert not exceeded(loop, proof, np.random.default_rng(0), 30.0)


def test_the_time_between_events_is_shorter_by_the_noise_of_two_measurements(witness: Proved) -> None:
    """A document that names a longer time proves no longer one."""
    drift, rate = drift_of(witness.proof), witness.document["rate"]
    without = inter_event_s(LOOP._replace(noise=zeros(2, 0)), rate, drift)
    once = inter_event_s(noisy(LOOP, SIZE / 2), rate, drift)
    assert without > once > 1.1 * witness.document["inter_event_s"]
    for named in (without, once):
        proof = prove_by_forms(LOOP, {**witness.document, "inter_event_s": named})
        assert proof.inter_event == prove_by_forms(LOOP, witness.document).inter_event


def claim_a_longer_time(entry: dict[str, Any], longer: float) -> None:
    entry["apart"] = longer


def begin_without_noise(entry: dict[str, Any], longer: float) -> None:
    """As if x_s were x after an event."""
    entry["after"] = [0, 0]


def compare_without_noise(entry: dict[str, Any], longer: float) -> None:
    """As if the rule compared x_s − x."""
    for name, table in entry["multipliers"].items():
        if name.startswith("edge/"):
            table["facts"] = {fact: m for fact, m in table["facts"].items() if not fact.startswith("noise")}


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (claim_a_longer_time, "times: the rows may reach more within the time"),
        (begin_without_noise, "not proven at after/"),
        (compare_without_noise, "not proven to be never taken|not proven at edge/"),
    ],
)
def test_a_time_that_leaves_out_noise_is_rejected(
    witness: Proved, change: Callable[[dict[str, Any], float], None], reason: str
) -> None:
    document = proof_files(LOOP, witness.document, Naming("noisy"))
    proof = json.loads(document.proof)
    (entry,) = (each for each in proof["times"] if "apart" in each)
    drift = levels_of(witness.document["bounds"])["drift"]
    longer = inter_event_s(noisy(LOOP, SIZE / 2), witness.document["rate"], drift)
    change(entry, longer)
    with pytest.raises(RejectedByKernelError, match=reason):
        prove(document.document, json.dumps(proof))


def test_without_a_floor_noise_makes_events_at_once() -> None:
    loop = noisy(double_integrator(level=0.05))
    assert inter_event_s(loop, 0.3, (0.1, 0.0)) == 0
    found = completed(loop, proved("double_integrator").document)
    rejects(loop, found, "at edge/0 lost, sent/")


def test_a_start_is_quiet_up_to_the_noise_of_two_measurements() -> None:
    """At 20 ms We is about (0, −0.0197) without noise, and 0.015 below the floor."""
    loop = double_integrator(SCHEDULE._replace(start=fmpq(3, 100)), level=0.0)
    loop = with_rule(loop, floor=number(0.0347))
    for size, expected in ((0.0, True), (0.004, True), (0.005, True), (0.0065, False)):
        largest = np.hypot(2 * size, 0.0197 + 2 * size)
        assert (largest < 0.0347) == expected
        assert is_quiet(noisy(loop, size)) == expected


def test_errors_are_not_assumed_with_noise(witness: Proved) -> None:
    errors = {"decaying": 1.0, "constant": 1.0}
    document = completed(LOOP, {**witness.document}, whole=True)
    rejects(LOOP, {**document, "errors": errors}, "^errors: not with a periodic rule, .* or with noise")


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
    loop = with_rule(double_integrator(floor=0.03), always=True)
    model = Model(loop, number(0.3), number(0.8), Errors(arb(1), arb(1)))
    assert len(model.locations[0].nodes) == 1
    names = {item.name for item in model.inequalities("x", starts=True)}
    assert names
    assert not any("silent" in name for name in names)
