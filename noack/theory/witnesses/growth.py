"""The search for a witness of the growth of a time-triggered loop: a document for :mod:`noack_check.growth`.

Nothing here has to be right: the checker verifies what is found.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from noack.core.linear_systems import Matrix
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.effort import NoWitnessError
from noack.theory.witnesses.semidefinite import Accuracy, MatrixInequality, minimise
from noack_check.check import RejectedError
from noack_check.growth import Growth, PeriodicLoop, prove_growth

Document = Mapping[str, object]
_ACCURACY = Accuracy(gap=1e-6, feasibility=1e-9, improves_steps=True)
_MARGINS = (1e-7, 1e-6, 1e-5)
_SHARES = (0.5, 0.9)
"""Where between the growth of the worst pattern and 1 a bound is tried, in logarithms."""
_MOST_ENTRIES = 12_000
"""Of all forms: more would take minutes."""
_SQUARINGS = (24, 18, 12, 6)
"""Of a pattern's product, until its trace is known: more are more accurate, but lose digits."""
_RUNS, _STEPS = 20, 200


def stable_document(loop: PeriodicLoop, growth: float) -> tuple[Document, Growth]:
    """Return a document that proves that no pattern grows, and what the checker finds.

    Args:
        loop: the loop.
        growth: of the worst pattern that is known, per period.

    Raises:
        NoWitnessError: none was found.
    """
    for memory, share in itertools.product((0, 1), _SHARES):
        words = [*_words(loop, memory)]
        size = loop.lost[0].nrows()
        if len(words) * len(loop.lost) * size * (size + 1) // 2 > _MOST_ENTRIES:
            break
        factor = growth ** (1 - share)
        for margin in _MARGINS:
            forms = _forms(loop, words, factor, margin)
            if forms is None:
                break
            document = {"losses": loop.losses, "stable": {"factor": factor, "words": forms}}
            try:
                return document, prove_growth(loop, document)
            except RejectedError:
                continue
    raise NoWitnessError("the solver finds no quadratic forms that decrease under every pattern")


def unstable_document(loop: PeriodicLoop, pattern: Sequence[bool]) -> tuple[Document, Growth]:
    """Return a document that proves the growth of a pattern, and what the checker finds.

    Raises:
        NoWitnessError: it is not accepted.
    """
    letters = "".join("DL"[not is_delivered] for is_delivered in pattern)
    why = ""
    for squarings in _SQUARINGS:
        document = {"losses": loop.losses, "unstable": {"pattern": letters, "squarings": squarings}}
        try:
            return document, prove_growth(loop, document)
        except RejectedError as error:
            why = str(error)
    raise NoWitnessError(why)


def _words(loop: PeriodicLoop, memory: int) -> Iterator[str]:
    """Yield the words of all losses since the last delivery, and of ``memory`` losses in a row before it."""
    before = [""]
    for _ in range(memory):
        before = [word + "D" + "L" * losses for word in before for losses in range(loop.losses + 1)]
    for word in {"", *before}:
        for losses in range(loop.losses + 1):
            yield word + "D" + "L" * losses


def _forms(
    loop: PeriodicLoop, words: Sequence[str], factor: float, margin: float
) -> dict[str, list[list[list[float]]]] | None:
    """Return the forms by word and slot that decrease by a factor; None: the solver finds none."""
    maps = {"D": [floats(M) for M in loop.delivered], "L": [floats(M) for M in loop.lost]}
    slots, frame = len(loop.lost), _frame(loop, maps)
    inverse = np.linalg.inv(frame)
    scaled = {outcome: [inverse @ M @ frame for M in matrices] for outcome, matrices in maps.items()}
    size, problem = len(frame), []
    identity = np.eye(size)
    for slot, word in itertools.product(range(slots), words):
        name = f"{word} {slot}"
        problem.append(MatrixInequality(((name, identity / 2, identity),), (), -identity))
        for outcome in "DL":
            if outcome == "L" and not loop.allows_loss(word):
                continue
            M, to = scaled[outcome][slot], f"{_longest(words, word + outcome)} {(slot + 1) % slots}"
            parts = ((name, factor**2 * identity / 2, identity), (to, -M / 2, M))
            problem.append(MatrixInequality(parts, (("level", 0 * identity),), 0 * identity))
        problem.append(
            MatrixInequality(((name, -identity / 2, identity),), (("level", identity),), 0 * identity)
        )
    answer = minimise({"level": 1.0}, problem, margin=margin, accuracy=_ACCURACY)
    if not answer.is_solved:
        return None
    forms: dict[str, list[list[list[float]]]] = {word: [] for word in words}
    for word, slot in itertools.product(words, range(slots)):
        P = inverse.T @ answer.matrices[f"{word} {slot}"] @ inverse
        forms[word].append(((P + P.T) / 2).tolist())
    return forms


def _longest(words: Sequence[str], outcomes: str) -> str:
    return next(outcomes[begin:] for begin in range(len(outcomes)) if outcomes[begin:] in words)


def _frame(loop: PeriodicLoop, maps: Mapping[str, Sequence[Matrix]]) -> Matrix:
    """Return coordinates in which states of drawn runs have similar sizes in all directions."""
    rng, slots, size = np.random.default_rng(0), len(loop.lost), loop.lost[0].nrows()
    moments = np.zeros((size, size))
    for _ in range(_RUNS):
        z, word = rng.normal(size=size), "D"
        for number in range(_STEPS):
            is_lost = loop.allows_loss(word) and rng.random() < 0.7
            outcome = "DL"[is_lost]
            z = maps[outcome][number % slots] @ z
            word = (word + outcome)[-100:]
            if not (scale := float(np.linalg.norm(z))) > 0:
                break
            z /= scale
            moments += np.outer(z, z)
    values, vectors = np.linalg.eigh(moments / max(np.trace(moments), 1e-300))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 1e-8)))
