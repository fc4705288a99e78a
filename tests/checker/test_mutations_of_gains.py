"""Changed documents of gains alone: the checker rejects them, or what it accepts is true.

A document of gains states no bound: the checker derives all from what it names. So many changes are valid
proofs of other numbers. Random runs of the loop have to stay within the least of all.
"""

import copy
import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat

from noack.core.balls import identity, number
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.loop import Loop, LoopObserver
from noack.proof.statement_proof import prove_statement
from noack.theory.witnesses.documents import witness_by_gains
from tests.checker.changes import GAINS, LOOPS, WINDOWS, accepted, places
from tests.checker.loops import AREA, DUE, IDEAL, SCHEDULE, scalar, with_form
from tests.checker.runs import exceeded, require_true

Document = dict[str, Any]
Rng = np.random.Generator
_OUTPUTS = ("x", "e_s", "e_c", "u[0]")


def estimated(*gains: arb_mat) -> Loop:
    """Return a loop with a disturbance, whose sensor estimates its state from noisy measurements."""
    loop, one = scalar(1, SCHEDULE, floor=0.05), identity(1)
    return loop._replace(
        observer=LoopObserver(gains, one, number(0.1) * one, loop.times.sampling),
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
    *((name, 16) for name in ("a form", "a threshold", "an integral", "a deadline", "an observer")),
    *(pytest.param(name, 60, marks=pytest.mark.deep) for name in ("a form", "a threshold")),
    *(pytest.param(name, 48, marks=pytest.mark.deep) for name in ("an integral", "a deadline")),
    pytest.param("an integral at all times", 120, marks=pytest.mark.deep),
    pytest.param("an observer", 110, marks=pytest.mark.deep),
    pytest.param("a filter", 100, marks=pytest.mark.deep),
]
"""How many changes of each are tried: above 200 without an observer, and with one."""


@functools.cache
def base(name: str) -> Document:
    """Return a document that is accepted."""
    return dict(witness_by_gains(BASES[name], _OUTPUTS).document)


@pytest.mark.parametrize(("name", "count"), COUNTS)
def test_changed_documents_prove_nothing_false(name: str, count: int) -> None:
    loop = BASES[name]
    rng, proofs, rejected = np.random.default_rng(count), [prove_statement(loop, base(name))], 0
    for k in range(count):
        document = copy.deepcopy(base(name))
        list(GAINS.values())[k % len(GAINS)](document, rng)
        proof = accepted(loop, document)
        proofs += [proof] if proof is not None else []
        rejected += proof is None
    require_true(loop, proofs, 3)
    assert rejected > count // 10
    assert len({float(bound.decaying + bound.constant) for p in proofs for bound in p.bounds}) > count // 8


def test_an_integral_over_any_time_proves_nothing_false() -> None:
    loop, proofs = BASES["an integral at all times"], []
    for factor in WINDOWS:
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
        prove_statement(BASES[of], document)


# Changes of loops, which a document of gains does not name: its bounds are those of the changed loop.


@pytest.mark.parametrize("name", ["a threshold", pytest.param("an observer", marks=pytest.mark.deep)])
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
