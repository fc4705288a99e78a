"""Rules whose tests are an exact time apart: dwell times, dynamic variables, grids; false witnesses, runs."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from noack.core.balls import beside, identity, matrix, number, zeros
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop, Times
from noack.proof.elaborate.tests_apart import PlaceAtTest, Places
from noack.proof.statement_proof import prove_statement
from tests.checker.changes import DOCUMENTS, accepted
from tests.checker.changes import LOOPS as OTHER_LOOPS
from tests.checker.completed import completed
from tests.checker.loops import (
    DYNAMIC_RULE,
    IDEAL,
    SCHEDULE,
    TESTED_APART,
    double_integrator,
    dwelling,
    dynamic,
    held,
    of_scenario,
    trigger_setting,
)
from tests.checker.proofs import Proved, proved
from tests.checker.runs import exceeded, floats

T = fmpq(1, 100)
NAMES = list(TESTED_APART)


def base(name: str) -> tuple[Loop, Proved]:
    found = proved(f"tests_{name}")
    return found.loop, found


@pytest.mark.parametrize("name", NAMES)
def test_runs_stay_below_the_bounds(name: str) -> None:
    loop, witness = base(name)
    rng = np.random.default_rng(1)
    for _ in range(2):
        assert exceeded(loop, witness.proof, rng, 4.0) == []


@pytest.mark.parametrize(
    ("name", "share"),
    [("dwell", 0.6), ("dynamic", 0.6), ("switching", 0.97), ("grid", 0.5), ("held", 0.93)],
)
def test_runs_come_near_the_bounds(name: str, share: float) -> None:
    loop, witness = base(name)
    rng = np.random.default_rng(1)
    bounds = tuple(
        b._replace(decaying=b.decaying * number(share), constant=b.constant * number(share))
        for b in witness.proof.bounds
        if b.output == "x"
    )
    smaller = witness.proof._replace(bounds=bounds)
    assert any(exceeded(loop, smaller, rng, 4.0) for _ in range(6))


# Where updates are at the tests.


def places(times: Times, losses: int = 1, later: int = 2, at_start: int = 2) -> Places:
    return Places(losses, times, later, at_start)


def test_an_update_acts_before_its_delay() -> None:
    """Tests every 10 ms, a delay of 25 ms: its age at a test is 0, 10 or 20 ms."""
    times = Times(T, T, fmpq(1, 40), fmpq(0), fmpq(0))
    found = places(times)
    ages = {place.ages for place in found.places if place.ages}
    zero, one, two = 0 * T, T, 2 * T
    assert ages == {(zero,), (one,), (two,), (one, zero), (two, zero), (two, one), (two, one, zero)}
    for place in found.places:
        nodes = found.nodes(place, 1)
        assert nodes[-1] == (T if place.ages[:1] != (two,) else fmpq(1, 200))
    tests = {move.source for move in found.moves if move.kind != "arrival"}
    assert not any(place.ages[:1] == (two,) for place in tests)


def test_the_update_that_acts_next_is_any_of_those_on_their_way() -> None:
    found = places(Times(T, T, fmpq(1, 40), fmpq(0), fmpq(0)))
    source = PlaceAtTest(0, (2 * T, T, 0 * T))
    targets = {move.target for move in found.moves if move.source == source and move.kind == "arrival"}
    assert targets == {
        PlaceAtTest(0, (T, 0 * T)),
        PlaceAtTest(0, (0 * T,)),
    }  # two lost ones would be too many
    two = places(Times(T, T, fmpq(1, 40), fmpq(0), fmpq(0)), losses=2)
    targets = {move.target for move in two.moves if move.source == source and move.kind == "arrival"}
    assert PlaceAtTest(2, ()) in targets


def test_a_dwell_time_has_no_test_that_counts() -> None:
    loop = dwelling()
    found = places(loop.times, later=0, at_start=0)
    for move in found.moves:
        if move.is_event:
            assert move.target.dwells
            assert found.clock_end(move.target) == 5 * T
        elif move.kind == "silent":
            assert found.clock_end(move.target) == T
    assert {place.ages for place in found.places if place.has_input} == {(), (0 * T,)}


def test_too_many_places_are_rejected() -> None:
    loop = dynamic()._replace(times=Times(T, T, fmpq(1, 5), fmpq(0), fmpq(0)))
    of_nothing = {"output": "x", "decay": 1.0, "matrices": {}, "numbers": {}}
    with pytest.raises(RejectedError, match="ways in which updates"):
        prove_statement(loop, {"rate": 0.0, "later": 8, "bounds": [of_nothing]})


def test_each_way_to_the_next_memory_has_an_edge() -> None:
    """η becomes what it has decayed to and gained, or 0."""
    model, rng = Model(dynamic(), arb(0), arb(1)), np.random.default_rng(0)
    memory = model.memory
    assert memory is not None
    tests = [edge for edge in model.edges if edge.is_test]
    assert len(tests) == 4
    y = int(np.flatnonzero(floats(model.y)[0])[0])
    for edge in tests:
        assert edge.memory is not None
        z = rng.normal(size=model.size)
        x, seen = floats(model.x) @ z, floats(model.loop.gain) @ floats(model.e) @ z
        pair = np.concatenate([x, seen])
        step_s, decay = 0.02, float(memory.decay)
        if edge.name.split(", ")[1] != "silent":
            pair = np.concatenate([x, 0 * seen])  # an event leaves no error
        gained = -np.expm1(-decay * step_s) / decay * pair @ floats(memory.gain) @ pair
        expected = 0.0 if edge.name.endswith("none") else np.exp(-decay * step_s) * z[y] ** 2 + gained
        assert z @ floats(edge.memory) @ z == pytest.approx(expected)


@pytest.mark.parametrize("gain", [[[-1.0, -1.4]], [[0.0, 0.0]]])
def test_a_loop_starts_with_the_noise_of_its_measurement(gain: list[list[float]]) -> None:
    """With forms of K e_s, too: it is what an event leaves. A gain without rank has none of K e_s."""
    loop = dynamic()._replace(holds=True, noise=matrix([[0.01, 0.0], [0.0, 0.02]]), gain=matrix(gain))
    model = Model(loop, arb(0), arb(1))
    assert model.sees_all == (gain[0][0] == 0)
    z = floats(model.jump(model.noise, 0 * model.w, ())) @ floats(model.p).T
    [start] = {name: floats(left) for name, left, _ in model.start_inequality().parts}.values()
    [(_, form)] = model.form(0, 0).parts
    assert abs(start[:, 1:]) == pytest.approx(abs(floats(form) @ z[[*model.locations[0].coordinates]]) / 2)


def test_silent_tests_are_counted_since_the_last_event() -> None:
    found = Places(1, Times(T, T, 2 * T, fmpq(0), fmpq(0)), 1, 1, counted=3)
    assert {place.silent for place in found.places} == {0, 1, 2, 3}
    for move in found.moves:
        following = {"silent": min(move.source.silent + 1, 3), "arrival": move.source.silent}
        assert move.target.silent == following.get(move.kind, 0)


def test_between_knots_forms_are_affine_in_the_number_of_silent_tests() -> None:
    model = Model(held(), arb(0), arb(1), by_tests=True, counted=16)
    silent = [model.silent_tests(index) for index in range(len(model.locations))]
    of_each = {count: model.form(silent.index(count), 1).parts for count in (13, 14, 16)}
    names = {count: [name for name, _ in parts] for count, parts in of_each.items()}
    assert names[14] == ["P/0 lost", "P/0 lost, 13 silent, 1", "P/0 lost, 16 silent, 1"]
    assert (names[13], names[16]) == (names[14][:2], [names[14][0], names[14][2]])
    before, after = (float(S[0, 0] ** 2) for _, S in of_each[14][1:])
    assert (before, after) == pytest.approx((2 / 3 * 0.006, 1 / 3 * 0.006))


# False witnesses.


CHANGES: dict[str, Callable[[Loop], Loop]] = {
    "one loss more": lambda loop: loop._replace(losses=loop.losses + 1),
    "larger start": lambda loop: loop._replace(start=loop.start * number(1.02)),
    "another plant": lambda loop: loop._replace(B=loop.B * number(0.2)),
    "a disturbance": lambda loop: loop._replace(pushes=arb_column(loop.n), sizes=(arb(0.05),)),
    "tests twice as far apart": lambda loop: loop._replace(
        times=loop.times._replace(sampling=2 * loop.times.sampling, least_sampling=2 * loop.times.sampling)
    ),
}


REASONS = {
    "one loss more": "motion/1 lost|edge/1 lost, dwells, lost, 2 lost",
    "larger start": "start$",
    "another plant": "motion/0 lost/",
    "a disturbance": "motion/0 lost/",
    "tests twice as far apart": "motion/0 lost/|edge/0 lost, silent",
}


def arb_column(n: int) -> Any:
    return matrix([[1.0]] * n)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", CHANGES)
def test_a_witness_proves_nothing_about_another_loop(name: str, change: str) -> None:
    loop, witness = base(name)
    other = CHANGES[change](loop)
    with pytest.raises(RejectedError, match=f"at ({REASONS[change]})"):
        prove_statement(other, completed(other, witness.document, whole=True))


def test_a_longer_dwell_time_and_another_memory_are_rejected() -> None:
    loop, witness = base("dwell")
    longer = loop._replace(times=loop.times._replace(dwell=8 * T))
    with pytest.raises(RejectedError, match="controller's model: not proven at motion/0 lost, dwells/"):
        prove_statement(longer, completed(longer, witness.document, whole=True))
    loop, witness = base("dynamic")
    memory = loop.rule.memory
    assert memory is not None
    for other, reason in (
        (memory._replace(gain=memory.gain * 2), r"at edge/0 lost, silent"),
        (memory._replace(start=arb(9)), r"at start$"),
        (memory._replace(decay=arb(0)), r"at edge/0 lost, silent"),
    ):
        changed = loop._replace(rule=loop.rule._replace(memory=other))
        with pytest.raises(RejectedError, match=reason):
            prove_statement(changed, completed(changed, witness.document))


def test_a_negative_coefficient_of_the_memory_is_rejected() -> None:
    """η is bounded from above only, so V may not fall with it."""
    loop, witness = base("dynamic")
    document: Any = copy.deepcopy(witness.document)
    numbers = document["bounds"][0]["numbers"]
    for name in numbers:
        if name.startswith("eta/"):
            numbers[name] = -abs(numbers[name])
    with pytest.raises(RejectedError, match="edge/0 lost, silent, 0 lost/1 0: a multiplier below 0"):
        prove_statement(loop, document)


def test_the_error_has_no_bound_where_the_model_has_only_its_input() -> None:
    loop, witness = base("switching")
    document: Any = copy.deepcopy(witness.document)
    document["bounds"][0]["output"] = "e_s"
    with pytest.raises(RejectedError, match="e_s"):
        prove_statement(loop, document)


def test_a_witness_counts_as_many_tests_as_it_has_forms_for() -> None:
    loop, witness = base("held")
    counted: Any = witness.document["counted"]
    for other in (0, counted // 2, counted + 1, 10**6, -1):
        with pytest.raises(RejectedError, match=r"not proven at edge/|unknown matrix|^counted"):
            prove_statement(loop, {**witness.document, "counted": other})
    with pytest.raises(RejectedError, match="counted"):
        prove_statement(double_integrator(SCHEDULE), {"rate": 0.0, "counted": 4, "bounds": []})


def test_the_drift_bounds_no_error_during_a_dwell_time() -> None:
    loop, witness = base("dwell")
    document: Any = copy.deepcopy(witness.document)
    document["bounds"][0]["output"] = "drift"
    with pytest.raises(RejectedError, match="mismatch of the sensor's model: not proven at output/0 lost/"):
        prove_statement(loop, document)
    with pytest.raises(RejectedError, match="errors"):
        prove_statement(loop, {**witness.document, "errors": {"decaying": 1.0, "constant": 1.0}})


WRONG: dict[str, Callable[[Loop], Loop]] = {
    "no tests": lambda loop: loop._replace(times=IDEAL._replace(dwell=fmpq(1))),
    "tests at unknown times": lambda loop: loop._replace(times=loop.times._replace(least_sampling=T / 4)),
    "a dwell time before the next test": lambda loop: loop._replace(times=loop.times._replace(dwell=T / 4)),
    "a memory that begins below 0": lambda loop: with_memory(loop, start=arb(-1)),
    "a memory that gains below 0": lambda loop: with_memory(loop, gain=identity(3) * -1),
    "a memory of another size": lambda loop: with_memory(loop, gain=identity(5)),
    "a memory that gains while no test counts": lambda loop: loop._replace(
        times=loop.times._replace(dwell=5 * T)
    ),
}


def with_memory(loop: Loop, **changed: Any) -> Loop:
    assert loop.rule.memory is not None
    return loop._replace(rule=loop.rule._replace(memory=loop.rule.memory._replace(**changed)))


@pytest.mark.parametrize("name", WRONG)
def test_a_loop_that_is_none_is_rejected(name: str) -> None:
    loop = dynamic()
    loop = loop._replace(times=loop.times._replace(sampling=T, least_sampling=T))
    assert loop.fault() == ""
    with pytest.raises(RejectedError, match=r"^loop: "):
        prove_statement(WRONG[name](loop), {"rate": 0.0, "bounds": []})


def test_forms_of_each_test_need_tests_at_exact_times() -> None:
    loop = double_integrator(SCHEDULE._replace(least_sampling=T / 4))
    with pytest.raises(RejectedError, match="by_tests"):
        prove_statement(loop, {"rate": 0.0, "by_tests": True, "bounds": []})


def of_memory(field: str, factor: float) -> Callable[[Loop, np.random.Generator], Loop]:
    def change(loop: Loop, rng: np.random.Generator) -> Loop:
        memory = loop.rule.memory
        return (
            loop if memory is None else with_memory(loop, **{field: getattr(memory, field) * number(factor)})
        )

    return change


def with_dwell(factor: fmpq) -> Callable[[Loop, np.random.Generator], Loop]:
    return lambda loop, rng: loop._replace(times=loop.times._replace(dwell=loop.times.dwell * factor))


OF_LOOPS = OTHER_LOOPS | {
    "another decay of the memory": of_memory("decay", 0.9),
    "another gain of the memory": of_memory("gain", 1.1),
    "another start of the memory": of_memory("start", 1.5),
    "a longer dwell time": with_dwell(fmpq(6, 5)),
    "a shorter dwell time": with_dwell(fmpq(4, 5)),
    "no dwell time": with_dwell(fmpq(0)),
}


@pytest.mark.deep
@pytest.mark.parametrize("name", TESTED_APART)
@pytest.mark.parametrize("change", [*DOCUMENTS, *OF_LOOPS])
def test_what_is_accepted_of_changed_witnesses_is_true(name: str, change: str) -> None:
    """Random runs stay within what was accepted."""
    loop, witness = base(name)
    for seed in range(2):
        rng, document = np.random.default_rng(seed), copy.deepcopy(witness.document)
        changed = OF_LOOPS[change](loop, rng) if change in OF_LOOPS else loop
        if change in DOCUMENTS:
            if change == "outputs swapped" and len(document["bounds"]) < 2:
                continue
            DOCUMENTS[change](document, rng)
        if (proof := accepted(changed, document)) is None:
            continue
        for _ in range(2):
            assert exceeded(changed, proof, rng, 3.0) == []


# From scenarios.


DUE = {
    "self-triggered": (
        {"policy": "self_triggered", "beta": 0.3, "alpha_per_s": 0.5, "growth_per_s": 1.0,
         "mismatch_per_s": 1.0, "shortest_s": 0.01, "longest_s": 0.2},
        fmpq(1, 100), fmpq(1, 5),
    ),
    "area with a deadline": (
        {"policy": "deadline", "interval_s": 0.1, "rule": {"policy": "send_on_area", "delta_s": 0.1}},
        fmpq(1, 500), fmpq(1, 10),
    ),
    "a deadline before the dwell time ends": (
        {"policy": "deadline", "interval_s": 0.1,
         "rule": {"policy": "dwell", "interval_s": 0.3, "rule": {"policy": "absolute", "delta": 0.1}}},
        fmpq(1, 10), fmpq(1, 10),
    ),
    "a dwell time of a period": (
        {"policy": "dwell", "interval_s": 0.3, "rule": {"policy": "periodic", "period_s": 0.1}},
        fmpq(3, 10), fmpq(3, 10),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DUE)
def test_rules_whose_events_do_not_depend_on_a_comparison(name: str) -> None:
    trigger, least, most = DUE[name]
    loop = of_scenario("double_integrator", trigger_setting(trigger))
    assert (loop.times.least_period, loop.times.period) == (least, most)
    assert loop.rule.positive.nrows() == 0
    assert loop.fault() == ""


@pytest.mark.parametrize(
    ("trigger", "ideal", "key"),
    [
        (DYNAMIC_RULE, True, "trigger.policy"),
        (
            {"policy": "dwell", "interval_s": 0.1, "rule": {"policy": "send_on_area", "delta_s": 0.1}},
            False,
            "trigger.policy",
        ),
        ({"policy": "lyapunov", "rate_per_s": 0.3}, False, "trigger.policy"),
    ],
)
def test_what_needs_tests_at_times_is_refused_without(trigger: dict[str, Any], ideal: bool, key: str) -> None:
    with pytest.raises(RefusedError, match=key):
        of_scenario("double_integrator", trigger_setting(trigger), ideal=ideal)


def test_a_quadratic_rule_of_one_output_needs_no_other_errors() -> None:
    assert floats(base("switching")[0].seen).tolist() == [[1.0, 0.0]]
    assert base("grid")[0].seen is None
    loop = dynamic()._replace(holds=True)
    assert floats(loop.seen).tolist() == floats(loop.gain).tolist()
    rule = dwelling().rule
    assert (
        dwelling()._replace(holds=True, rule=rule._replace(positive=beside(zeros(2, 2), identity(2)))).seen
        is None
    )
