"""Changed witnesses of times between events: the checker rejects them, or what it accepts is true.

Runs with the shortest times that are found, of loops with one state, decide what is false: a time that is
longer has to be rejected. Those that are accepted are no longer than the times of all these runs.
"""

import copy
import functools
import itertools
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from flint import fmpq

from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from noack.theory.witnesses.documents import witness_by_gains
from tests.checker.changes import DOCUMENTS, GAINS, LOOPS, accepted, places, scaled
from tests.checker.loops import DRIFTING, IDEAL, NOISE, steady
from tests.checker.proofs import proved
from tests.checker.shortest import STEP_S, Shortest, shortest_times

Document = dict[str, Any]
Rng = np.random.Generator
_ROUNDING_S = 1e-9
_TESTS = IDEAL._replace(sampling=fmpq(1, 50), least_sampling=fmpq(1, 50), delay=fmpq(1, 50))
BY_GAINS: dict[str, Loop] = {
    "two losses": steady(2),
    "a kink": steady(2, level=1.1),
    "noise": steady(0, disturbance=1.0)._replace(noise=NOISE),
    "a delay": steady(1, times=IDEAL._replace(delay=fmpq(1, 20))),
    "tests": steady(1, times=_TESTS),
}
BASES = BY_GAINS | DRIFTING


@functools.cache
def base(name: str) -> Document:
    """Return a document that is accepted: by gains alone, or by the bound of a drift alone."""
    if name in BY_GAINS:
        return dict(witness_by_gains(BY_GAINS[name], ("x",)).document)
    document = proved(name.replace(" ", "_")).document
    return {key: value for key, value in document.items() if key != "gains"}


@functools.cache
def shortest(name: str) -> Shortest:
    return shortest_times(BASES[name])


def longer(loop: Loop, proof: Proof, times: Shortest) -> list[str]:
    """Return which of the times that are proven are longer than those of runs."""
    room = _ROUNDING_S if loop.times.sampling > 0 else STEP_S
    pairs = {"between events": (proof.inter_event, times.any if proof.is_quiet else times.later)}
    if proof.is_quiet:
        pairs |= {"first event": (proof.first_event, times.first), "quiet": (loop.times.start, times.quiet)}
    return [
        f"{name}: {float(stated)} instead of {found}"
        for name, (stated, found) in pairs.items()
        if stated is not None and float(stated) > found + room
    ]


def is_longer(document: Document, times: Shortest) -> bool:
    """Return whether a document by gains states a time that is longer than that of a run."""
    stated = document.get("gains", {}).get("inter_event_s", 0.0)
    return bool(stated > min(times.first, times.any) + STEP_S)


# Changes of documents.


def _near(document: Document, rng: Rng) -> None:
    found = places(document.get("gains", document), "inter_event_s")
    container, key = found[rng.integers(len(found))]
    container[key] *= float(rng.uniform(0.95, 1.7))


TIMES: dict[str, Callable[[Document, Rng], object]] = {
    "time between events": scaled("inter_event_s"),
    "a time near the true one": _near,
    "another time near it": _near,
}
OF_GAINS, OF_DRIFT = (
    [change for each in changes.values() for change in (*TIMES.values(), each)]
    for changes in (GAINS, DOCUMENTS)
)


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("two losses", 10),
        ("a first event", 12),
        *(pytest.param(name, 24, marks=pytest.mark.deep) for name in BY_GAINS),
        *(pytest.param(name, 60, marks=pytest.mark.deep) for name in DRIFTING),
    ],
)
def test_changed_documents_prove_no_time_that_is_too_long(name: str, count: int) -> None:
    loop, rng, changes = BASES[name], np.random.default_rng(count), OF_GAINS if name in BY_GAINS else OF_DRIFT
    assert prove_statement(loop, base(name))
    tried = rejected = false = 0
    for change in itertools.cycle(changes):
        document = copy.deepcopy(base(name))
        change(document, rng)
        if document == base(name):
            continue
        tried += 1
        proof = accepted(loop, document)
        if proof is None:
            rejected += 1
            false += is_longer(document, shortest(name))
        else:
            assert longer(loop, proof, shortest(name)) == []
        if tried == count:
            break
    assert false <= rejected < count
    if name in BY_GAINS:  # by forms a document states no time: the longest one is proven up to what it names
        assert false >= count // 12


# Changes of loops, of which a document states a time.


def changed_loops(name: str) -> Iterator[Loop]:
    for seed, change in enumerate(LOOPS.values()):
        loop = change(BASES[name], np.random.default_rng(seed))
        if repr(loop) != repr(BASES[name]):
            yield loop


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name == "a drift" else pytest.mark.deep) for name in BASES],
)
def test_changed_loops_have_no_time_that_is_too_long(name: str) -> None:
    proven = rejected = 0
    for loop in changed_loops(name):
        proof = accepted(loop, base(name))
        if proof is None:
            rejected += 1
        else:
            proven += 1
            assert longer(loop, proof, shortest_times(loop)) == []
    assert min(proven, rejected) > 2
