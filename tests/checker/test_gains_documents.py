"""Documents of loops for bounds by gains: strictly read, and each number counts."""

import copy
import functools
import json
from collections.abc import Callable
from typing import Any

import pytest
from flint import arb, fmpq

from noack.core.balls import identity, matrix, number
from noack.proof.elaborate.loop import Loop
from noack.proof.gains_document import gains_files
from noack.proof.loop_document import Naming
from noack_gains import Document, Proven, RejectedError, in_words, prove
from tests.checker.loops import DUE, SCHEDULE, double_integrator, pushed, scalar, with_form
from tests.checker.proofs import by_gains

Table = dict[str, Any]
FORM = [[-0.01, 0.02], [0.02, 1.0]]


def perturbed() -> Loop:
    """Return a loop in which each key of a document has a value: noise, a disturbance, unknown entries."""
    loop = scalar(1, SCHEDULE, floor=0.05)
    return loop._replace(
        noise=number(0.002) * identity(1),
        pushes=identity(1),
        sizes=(number(0.01),),
        half_A=number(0.01) * identity(1),
        half_B=number(0.01) * identity(1),
        push_before_input=number(0.02) * identity(1),
        offset=arb(0.001),
    )


LOOPS: dict[str, Callable[[], Loop]] = {
    "perturbed": perturbed,
    "two states": lambda: pushed(double_integrator(SCHEDULE, floor=0.05), 0.01),
    "a form": lambda: with_form(scalar(1, SCHEDULE), FORM),
    "a deadline": lambda: DUE,
}


@functools.cache
def files(name: str) -> tuple[Table, Table]:
    """Return the tables of a document and of its proof, which names no digest."""
    loop = LOOPS[name]()
    document, _ = by_gains(loop)
    found = gains_files(loop, document, Naming(name))
    proof = json.loads(found.proof)
    del proof["document"]
    return json.loads(found.document), proof


def proven(document: Table, proof: Table) -> Proven:
    return prove(json.dumps(document), json.dumps(proof))


def sizes(found: Proven) -> dict[str, tuple[float, float]]:
    return {bound.output: (float(bound.levels[0]), float(bound.levels[1])) for bound in found.bounds}


@pytest.mark.parametrize("name", LOOPS)
def test_a_document_proves_what_the_search_found(name: str) -> None:
    found, (_, by_search) = proven(*files(name)), by_gains(LOOPS[name]())
    stated = {(float(b.decaying), float(b.constant)) for b in by_search.bounds if b.from_start}
    assert {*sizes(found).values()} == stated
    assert (found.inter_event or None) == by_search.inter_event


def test_a_document_in_words_has_its_numbers() -> None:
    words = "\n".join(in_words(Document(json.dumps(files("perturbed")[0]))))
    for part in (
        "entries of A are unknown to within [0.01]",
        "an unknown signal of at most 0.01 times [1]",
        "at most 1 updates in a row are lost",
        "with ‖W n‖ ≤ 0.002",
        "an event needs ‖(e x0)‖ above the larger of 0.1 e^(−0.25 t) or 0.05",
        "while no input acts, [0.02] is added to dx/dt",
        "the outputs are computed from a state that differs from x by at most 0.001",
    ):
        assert part in words, words


def scaled(key: str, factor: float, *places: Any) -> Callable[[Table], None]:
    def change(document: Table) -> None:
        container = document
        for place in (key, *places)[:-1]:
            container = container[place]
        last = (key, *places)[-1]
        container[last] *= factor

    return change


WEAKER: dict[str, Callable[[Table], None]] = {
    "a plant that decays less": lambda d: d["A"][0].__setitem__(0, d["A"][0][0] + 0.01),
    "more unknown entries of A": scaled("uncertainty", 1.01, "A", 0, 0),
    "more unknown entries of B": scaled("uncertainty", 1.01, "B", 0, 0),
    "a larger start": scaled("start", 1.01, 0, 0),
    "a larger level": scaled("rule", 1.01, "level"),
    "a larger floor": scaled("rule", 1.01, "floor"),
    "fewer tests": scaled("times", 1.01, "sampling"),
    "a longer delay": scaled("times", 1.01, "delay"),
    "an older input": scaled("times", 1.01, "age"),
    "a later first input": scaled("times", 1.01, "start"),
    "one loss more": lambda d: d.update(losses=2),
    "a larger disturbance": scaled("disturbances", 1.01, 0, "size"),
    "another column of a disturbance": scaled("disturbances", 1.01, 0, "column", 0, 0),
    "more noise": scaled("noise", 1.01, "constant"),
    "noise that decays": lambda d: d["noise"].update(decaying=0.001),
    "a push before the first input": scaled("before_input", 1.01, 0, 0),
    "a larger offset": scaled("offset", 1.01),
    "a model of another plant": scaled("model", 1.01, "A", 0, 0),
    "a smaller weight": scaled("weight", 0.99, 0, 0),
    "a larger output": lambda d: d["outputs"][0].update(rows=[[1.01]]),
}


@pytest.mark.parametrize("name", WEAKER)
def test_a_harmful_change_is_rejected_or_has_larger_bounds(name: str) -> None:
    document, proof = copy.deepcopy(files("perturbed"))
    before = sizes(proven(document, proof))
    assert document["times"]["age"] > 0
    assert document["times"]["start"] > 0
    WEAKER[name](document)
    if name == "a smaller weight":  # compared is W, too
        document["rule"]["compared"][0][1] *= 0.99
    try:
        after = sizes(proven(document, proof))
    except RejectedError:
        return
    assert any(sum(after[key]) > sum(before[key]) for key in before), name


REJECTED: dict[str, tuple[Callable[[Table, Table], object], str]] = {
    "an unknown key": (lambda d, p: d.update(more=1), "unknown key 'more'"),
    "a missing key": (lambda d, p: d.pop("losses"), "losses is missing"),
    "an unknown key of the rule": (lambda d, p: d["rule"].update(more=1), "rule: unknown key"),
    "a missing time": (lambda d, p: d["times"].pop("lead"), "times: lead is missing"),
    "another format": (lambda d, p: d.update(format="noack-gains-loop 2"), "not a file of the format"),
    "a state dropped": (lambda d, p: d["states"].pop(), "A: not 1 rows"),
    "no states": (lambda d, p: d.update(states=[]), "states: not from 1"),
    "a time below 0": (lambda d, p: d["times"].update(delay=-0.1), "delay: below 0"),
    "losses that are no number": (lambda d, p: d.update(losses=0.5), "losses: not a whole number"),
    "a negative half-width": (lambda d, p: d.update(uncertainty={"A": [[-1, 0], [0, 0]], "B": [[0], [0]]}),
                              "uncertainty: below 0"),
    "a gain that is an interval": (lambda d, p: d["gain"][0].__setitem__(0, [0, 1]), "an interval"),
    "an interval the wrong way": (lambda d, p: d["A"][0].__setitem__(0, [1, 0]), "not two ends"),
    "an output twice": (lambda d, p: d["outputs"].append(d["outputs"][0]), "occurs twice"),
    "a rate above the threshold's": (lambda d, p: d.update(rate=2 * d["rule"]["rate"]), "rate: it is larger"),
    "a rule without a comparison": (lambda d, p: d["rule"].update(compared=[]), "compares nothing"),
    "tests further apart": (lambda d, p: d["times"].update(least_sampling=9), "tests further apart"),
    "a limit of nothing": (lambda d, p: d.update({"while": [{"output": "y", "less": 1}]}), "while: no such"),
    "an unknown key of the proof": (lambda d, p: p.update(more=1), "proof: unknown key"),
    "a form that is not symmetric": (lambda d, p: p["plant"]["form"][0].__setitem__(1, 9), "not symmetric"),
    "a faster decay": (lambda d, p: p["plant"].update(decay=9), "not proven to decay"),
    "the model's form negative": (
        lambda d, p: p["model"].update(form=[[-1, 0], [0, -1]]), "not proven to decay",
    ),
    "no model": (lambda d, p: p.pop("model"), "model: missing"),
    "inputs without an inverse": (lambda d, p: p.update(inputs=[[0]]), "inverse"),
    "a time between events that is too long": (
        lambda d, p: p.update(inter_event_s=1.05 * p["inter_event_s"]), "an event may come earlier",
    ),
    "the threshold halved": (
        lambda d, p: d["rule"].update(level=d["rule"]["level"] / 2, floor=d["rule"]["floor"] / 2),
        "an event may come earlier",
    ),
    "another document": (lambda d, p: p.update(document="0" * 64), "another SHA-256"),
}  # fmt: skip


@pytest.mark.parametrize("name", REJECTED)
def test_a_false_file_is_rejected(name: str) -> None:
    document, proof = copy.deepcopy(files("two states"))
    proven(document, proof)
    change, reason = REJECTED[name]
    change(document, proof)
    with pytest.raises(RejectedError, match=reason):
        proven(document, proof)


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ('"losses": 1', '"losses": NaN', "not a number"),
        ('"losses": 1', '"losses": 1, "losses": 2', "the key 'losses' occurs twice"),
        ('"losses": 1', '"losses": 1e999', "not a number"),
        ('"losses": 1', '"losses": true', "not a number"),
        ("{", "[" * 100_000, "nested too deeply|not JSON"),
    ],
)
def test_a_text_that_is_no_strict_json_is_rejected(old: str, new: str, reason: str) -> None:
    document, proof = files("perturbed")
    text = json.dumps(document)
    assert old in text
    with pytest.raises(RejectedError, match=reason):
        prove(text.replace(old, new, 1), json.dumps(proof))


def test_of_another_rule_the_proof_has_to_say_what_a_silent_test_leaves() -> None:
    document, proof = copy.deepcopy(files("a form"))
    proven(document, proof)
    for entry, factor in (("errors", 1.001), ("share", 0.99)):
        changed = copy.deepcopy(proof)
        changed["comparison"][entry] = [[factor * v for v in row] for row in proof["comparison"][entry]]
        with pytest.raises(RejectedError, match="does not say as much"):
            proven(document, changed)
    with pytest.raises(RejectedError, match="one is needed"):
        proven(document, {key: value for key, value in proof.items() if key != "comparison"})


def test_a_deadline_that_is_later_has_larger_bounds_or_none() -> None:
    document, proof = copy.deepcopy(files("a deadline"))
    before = proven(document, proof)
    assert proof["by_time"] is True
    document["times"]["longest"] *= 1.01
    after = proven(document, proof)
    assert all(b.largest > a.largest for a, b in zip(before.bounds, after.bounds, strict=True))
    document["rule"]["always"] = False
    with pytest.raises(RejectedError, match="needs its comparison"):
        proven(document, proof)


def test_a_limit_is_open_unless_a_bound_is_below_it() -> None:
    document, proof = copy.deepcopy(files("perturbed"))
    (bound,) = (b for b in proven(document, proof).bounds if b.output == "all states")
    for factor, open_limits in ((1.01, 0), (0.99, 1)):
        less = factor * float(bound.largest)
        found = proven({**document, "while": [{"output": "all states", "less": less}]}, proof)
        assert len(found.open_limits) == open_limits
        assert all(("until |all states| = " in s) == bool(open_limits) for s in found.sentences())


def test_a_name_cannot_pass_for_a_part_of_the_sentence() -> None:
    document, proof = copy.deepcopy(files("perturbed"))
    document["outputs"][0]["name"] = name = "x| ≤ 0 at all times, |y"
    document["while"] = [{"output": name, "less": 0.001}]
    for sentence in proven(document, proof).sentences():
        assert f"until |{name!r}| = 0.001" in sentence
    assert proven(document, proof).sentences()[0].startswith(f"|{name!r}| ≤ ")


def test_numbers_of_a_file_are_exact() -> None:
    document, proof = copy.deepcopy(files("perturbed"))
    document["losses"], document["times"]["delay"] = "1/1", "1/10"
    assert Document(json.dumps(document)).times.delay == fmpq(1, 10)
    del proof["inter_event_s"]
    assert proven(document, proof).bounds
    assert matrix([[0.1]])[0, 0].fmpq() != fmpq(1, 10)
