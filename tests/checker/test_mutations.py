"""Changed documents and changed loops: the checker rejects them, or what it accepts is true.

What is accepted has to pass the inequalities in floating point, in :mod:`tests.checker.floating_forms`, which
has nothing of the checker's model, and random runs of the loop have to stay within what was proven.
"""

import copy
import functools

import numpy as np
import pytest

from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from tests.checker.changes import DOCUMENTS, LOOPS, Document, accepted
from tests.checker.floating_forms import Forms
from tests.checker.proofs import proved
from tests.checker.runs import exceeded

NAMES = ("plain", "pushed", "errors", "later", "noisy", "observed")


@functools.cache
def base(name: str) -> tuple[Loop, Document]:
    """Return a loop and a document that is accepted; "errors" uses facts about e and w."""
    known = proved("holds" if name == "errors" else f"changed_{name}")
    return known.loop, known.document


def is_true_or_rejected(loop: Loop, document: Document, seed: int) -> bool:
    """Return whether a document was rejected; what is accepted has to be true."""
    proof = accepted(loop, document)
    if proof is not None:
        require_true(loop, document, proof, seed, runs=3)
    return proof is None


def require_true(loop: Loop, document: Document, proof: Proof, seed: int, *, runs: int) -> None:
    rng = np.random.default_rng(seed)
    if "errors" not in document and not document["later"] and loop.observer is None:
        for entry in document["bounds"]:
            assert entry["output"] == "y[1]" or Forms(loop, document["rate"], entry).holds(
                entry["output"], rng
            )
    for _ in range(runs):
        assert exceeded(loop, proof, rng, 6.0) == []


def mutated_document(name: str, change: str, seed: int) -> bool:
    loop, document = base(name)
    other = copy.deepcopy(document)
    DOCUMENTS[change](other, np.random.default_rng(seed))
    return is_true_or_rejected(loop, other, seed)


def mutated_loop(name: str, change: str, seed: int) -> bool:
    loop, document = base(name)
    return is_true_or_rejected(LOOPS[change](loop, np.random.default_rng(seed)), document, seed)


@pytest.mark.parametrize("name", NAMES)
def test_the_documents_are_true(name: str) -> None:
    loop, document = base(name)
    require_true(loop, document, prove_statement(loop, document), 0, runs=1)


SOME_DOCUMENTS = (
    "multiplier of the other sign", "level 1 % smaller", "a matrix of the other sign", "outputs swapped",
    "rate + 5 %", "decay + 5 %",
)  # fmt: skip
SOME_LOOPS = (
    "one loss more",
    "K of the other sign",
    "box + 2 %",
    "a state 1 % off",
    "delay x 4",
    "start x 4",
)


@pytest.mark.parametrize("change", SOME_DOCUMENTS)
def test_some_changed_documents_are_rejected(change: str) -> None:
    assert mutated_document("pushed", change, 1)


@pytest.mark.parametrize("change", SOME_LOOPS)
def test_some_changed_loops_are_rejected(change: str) -> None:
    assert mutated_loop("pushed", change, 1)


@pytest.mark.deep
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", DOCUMENTS)
def test_changed_documents_prove_nothing_false(name: str, change: str) -> None:
    for seed in range(4):
        mutated_document(name, change, seed)


@pytest.mark.deep
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("change", LOOPS)
def test_changed_loops_make_nothing_false_proven(name: str, change: str) -> None:
    for seed in range(2):
        mutated_loop(name, change, seed)
