"""Changed documents of gains alone: the checker rejects them, or what it accepts is true.

A document of gains states no bound: the checker derives all from what it names. So many changes are valid
proofs of other numbers. Random runs of the loop have to stay within the least of all.
"""

import copy
import functools
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, fmpq

from noack.theory.witnesses.documents import witness_by_gains
from noack_check.balls import identity, number
from noack_check.check import RejectedError
from noack_check.loop import Loop, Observer
from noack_check.proof import Proof, prove
from tests.checker.runs import exceeded
from tests.checker.test_gains import AREA, DUE, scalar, with_form
from tests.checker.test_mutations import LOOPS
from tests.checker.test_witnesses import IDEAL, SCHEDULE

Document = dict[str, Any]
Rng = np.random.Generator
_OUTPUTS = ("x", "e_s", "e_c", "u[0]")
_SECONDS, _LESS = 3.0, 0.9


def estimated(*gains: arb_mat) -> Loop:
    """Return a loop with a disturbance, whose sensor estimates its state from noisy measurements."""
    loop, one = scalar(1, SCHEDULE, floor=0.05), identity(1)
    return loop._replace(
        observer=Observer(gains, one, number(0.1) * one, loop.times.sampling),
        noise=number(0.002) * one, pushes=one, sizes=(number(0.01),),
    )  # fmt: skip


BASES: dict[str, Loop] = {
    "a form": with_form(scalar(1, SCHEDULE), [[-0.01, 0.02], [0.02, 1.0]]),
    "a threshold": scalar(times=SCHEDULE),
    "an integral": AREA,
    "an integral at all times": AREA._replace(times=IDEAL),
    "a deadline": DUE,
    "an observer": estimated(number(0.3) * identity(1)),
    "a filter": estimated(*((number(g) + arb(0, 1e-6)) * identity(1) for g in (0.9, 0.6, 0.4, 0.3))),
}
COUNTS = [
    ("a form", 60),
    ("a threshold", 60),
    ("an integral", 48),
    pytest.param("an integral at all times", 120, marks=pytest.mark.system),
    ("a deadline", 48),
    ("an observer", 30),
    pytest.param("an observer", 110, marks=pytest.mark.system),
    pytest.param("a filter", 100, marks=pytest.mark.system),
]
"""How many changes of each are tried: above 200 without an observer, and with one."""


@functools.cache
def base(name: str) -> Document:
    """Return a document that is accepted."""
    return dict(witness_by_gains(BASES[name], _OUTPUTS).document)


# Changes of documents.


def places(table: Document, *keys: str) -> list[tuple[Any, Any]]:
    """Return where the numbers of a table are, each as a container and its key."""
    found: list[tuple[Any, Any]] = []
    pending = [(table, key) for key in keys if key in table]
    while pending:
        container, key = pending.pop()
        value = container[key]
        if isinstance(value, dict | list):
            pending += [(value, k) for k in (value if isinstance(value, dict) else range(len(value)))]
        else:
            found.append((container, key))
    return found


def scaled(*keys: str) -> Callable[[Document, Rng], None]:
    """Scale one number of some entries, by a little or by much; a number that is 0 is set."""

    def change(document: Document, rng: Rng) -> None:
        found = places(document.get("gains", {}), *keys) or places(document, *keys)
        if found:
            container, key = found[rng.integers(len(found))]
            factor = rng.choice([-1.0, 0.0, 0.5, 0.9, 0.99, 0.999, 1.001, 1.01, 1.1, 2.0, 10.0])
            container[key] = container[key] * factor if container[key] else factor / 100

    return change


def all_scaled(*keys: str) -> Callable[[Document, Rng], None]:
    """Scale all numbers of some entries by one factor."""

    def change(document: Document, rng: Rng) -> None:
        factor = rng.choice([0.2, 0.7, 0.98, 0.999, 1.001, 1.02, 1.5, 5.0])
        for container, key in places(document.get("gains", {}), *keys) or places(document, *keys):
            container[key] *= factor

    return change


def without(document: Document, rng: Rng) -> None:
    """Leave out an entry."""
    tables = [document["gains"], *(table for table in document["gains"].values() if isinstance(table, dict))]
    table = tables[rng.integers(len(tables))]
    del table[rng.choice(list(table))]


def swapped(document: Document, rng: Rng) -> None:
    """Let two tables change places."""
    gains = document["gains"]
    pairs = [("plant", "model"), ("outputs", "inputs")]
    pairs += [("errors", "shift"), ("errors", "share"), ("shift", "share")] if "comparison" in gains else []
    first, second = pairs[rng.integers(len(pairs))]
    table = gains if first in gains else gains["comparison"]
    if second in table:
        table[first], table[second] = table[second], table[first]


def another_rule(document: Document, rng: Rng) -> None:
    """Take the rule for another one, or an integral over more or less, or over another time."""
    gains = document["gains"]
    kind = rng.integers(4) if "window_s" not in gains else 3
    if kind == 3:
        gains["window_s"] = gains.get("window_s", 1.0) * rng.choice(_WINDOWS)
    elif kind == 0:
        gains["by_time"] = not gains.get("by_time", False)
    elif kind == 1:
        gains["tests"] = int(rng.choice([0, 1, 2, 5, 10, 40, 1000]))
    else:
        gains["tests"] = float(rng.choice([0.5, 1.0, 12.0]))


_WINDOWS = [-1.0, 0.0, 1e-6, 0.02, 0.2, 0.5, 0.9, 1.1, 2.0, 10.0, 1e9, np.inf, np.nan]
CHANGES: dict[str, Callable[[Document, Rng], None]] = {
    "rate": scaled("rate"),
    "time between events": scaled("inter_event_s"),
    "a number of a tail": scaled("plant", "model"),
    "a form of a tail": all_scaled("plant", "model"),
    "inputs": scaled("inputs"),
    "a number of Y, J or S": scaled("comparison"),
    "Y": all_scaled("comparison"),
    "an entry less": without,
    "two tables": swapped,
    "another rule": another_rule,
}


def longest(times: Iterable[fmpq | None]) -> fmpq | None:
    return max((time for time in times if time is not None), default=None)


def played(loop: Loop) -> Loop:
    """Return a loop as runs have it: tests at all times are often, for a little less than the threshold."""
    if loop.times.sampling > 0:
        return loop
    rule, step = loop.rule, fmpq(1, 500)
    less = rule._replace(level=number(_LESS) * rule.level, floor=number(_LESS) * rule.floor)
    return loop._replace(rule=less, times=loop.times._replace(sampling=step, least_sampling=step))


def require_true(loop: Loop, proofs: list[Proof], seed: int) -> None:
    """Require that runs stay within the least of some proofs of one loop."""
    kinds = {(float(proof.rate.mid()), proof.is_quiet) for proof in proofs}
    for rate, is_quiet in kinds:
        alike = [each for each in proofs if (float(each.rate.mid()), each.is_quiet) == (rate, is_quiet)]
        together = alike[0]._replace(
            bounds=tuple(bound for proof in alike for bound in proof.bounds),
            inter_event=longest(proof.inter_event for proof in alike),
            first_event=longest(proof.first_event for proof in alike),
        )
        for k in range(2):
            rng = np.random.default_rng((seed, k))
            assert exceeded(played(loop), together, rng, _SECONDS, by_forms=False) == []


def accepted(loop: Loop, document: Document) -> Proof | None:
    try:
        return prove(loop, document)
    except RejectedError:
        return None


@pytest.mark.parametrize(("name", "count"), COUNTS)
def test_changed_documents_prove_nothing_false(name: str, count: int) -> None:
    loop = BASES[name]
    rng, proofs, rejected = np.random.default_rng(count), [prove(loop, base(name))], 0
    for k in range(count):
        document = copy.deepcopy(base(name))
        list(CHANGES.values())[k % len(CHANGES)](document, rng)
        proof = accepted(loop, document)
        proofs += [proof] if proof is not None else []
        rejected += proof is None
    require_true(loop, proofs, 3)
    assert rejected > count // 8
    assert len({float(bound.decaying + bound.constant) for p in proofs for bound in p.bounds}) > count // 8


def test_an_integral_over_any_time_proves_nothing_false() -> None:
    loop, proofs = BASES["an integral at all times"], []
    for factor in _WINDOWS:
        document = copy.deepcopy(base("an integral at all times"))
        document["gains"]["window_s"] *= factor
        proof = accepted(loop, document)
        assert proof is None or 0 < factor < 1e9
        proofs += [] if proof is None else [proof]
    assert len({float(bound.constant) for proof in proofs for bound in proof.bounds}) > 2 * len(_OUTPUTS)
    require_true(loop, proofs, 3)


FALSE: dict[str, tuple[str, Callable[[Document], object], str]] = {
    "Y larger": (
        "a form", lambda d: all_numbers(d["gains"]["comparison"], "errors", 1.001), "does not say as much",
    ),
    "S smaller": (
        "a form", lambda d: all_numbers(d["gains"]["comparison"], "share", 0.99), "does not say as much",
    ),
    "J larger": (
        "a form", lambda d: all_numbers(d["gains"]["comparison"], "shift", 1.05), "does not say as much",
    ),
    "P of the other sign": (
        "a threshold", lambda d: all_numbers(d["gains"]["plant"], "form", -1.0), "plant: not proven to decay",
    ),
    "a faster decay": (
        "a threshold", lambda d: d["gains"]["model"].update(decay=0.8), "model: not proven to decay",
    ),
    "a later event": (
        "a threshold", lambda d: all_numbers(d["gains"], "inter_event_s", 1.05), "an event may come earlier",
    ),
    "no test": ("an integral", lambda d: d["gains"].update(tests=0), "not above 0"),
    "a time between events": (
        "an observer", lambda d: d["gains"].update(inter_event_s=0.05), "an event may come earlier",
    ),
}  # fmt: skip


def all_numbers(table: Document, key: str, factor: float) -> None:
    for container, place in places(table, key):
        container[place] *= factor


@pytest.mark.parametrize("name", FALSE)
def test_a_false_document_is_rejected(name: str) -> None:
    of, change, reason = FALSE[name]
    document = copy.deepcopy(base(of))
    change(document)
    with pytest.raises(RejectedError, match=reason):
        prove(BASES[of], document)


# Changes of loops, which a document of gains does not name: its bounds are those of the changed loop.


@pytest.mark.parametrize("name", ["a threshold", pytest.param("an observer", marks=pytest.mark.system)])
def test_changed_loops_make_nothing_false_proven(name: str) -> None:
    loop = BASES[name]
    proven = 0
    for seed, change in enumerate(LOOPS.values()):
        other = change(loop, np.random.default_rng(seed))
        proof = accepted(other, base(name))
        if proof is not None:
            proven += 1
            rng = np.random.default_rng(seed)
            assert exceeded(other, proof, rng, 1.0, by_forms=False) == [], change
    assert len(LOOPS) // 4 < proven < len(LOOPS)
