"""The search for a witness by gains: Lyapunov functions at a rate, and coordinates of the inputs.

Nothing here has to be right: ``noack_gains`` solves the inequalities and verifies the solution.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from noack.core.balls import number
from noack.core.linear_systems import Matrix
from noack.proof.elaborate.loop import Loop
from noack.proof.forms_proof import as_text
from noack.proof.gains_document import gains_document, proof_text
from noack.proof.loop_document import Naming, NoDocumentError
from noack.proof.search.results import compares_error
from noack.theory.response_bounds import NotDecayingError, lyapunov_decay
from noack.theory.witnesses.assumptions import before_due, observer_decay
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.effort import NoWitnessError
from noack_gains import Document, Gains, RejectedError, read_proof, share_of_threshold

_SHARES = (1.0, 0.5, 0.2, 0.0)
"""Rates that are tried, in multiples of the largest one."""
_FIRST_S, _NEARLY, _STEPS = 1e-6, 0.997, 16
"""A time between events is accepted if e_s reaches nearly the threshold."""
_LONGEST_S = 1e9
"""A longer time between events is not stated: nothing may move e_s."""
_AVERAGED = 2.0 ** np.arange(-8, 5)
"""Times over which an integral of the error is averaged, in time constants of the loop."""
_SLACK = 1e-10
"""Of the quadratic form of a rule, relatively, in the inequality of what a silent test says."""


def find_gains(loop: Loop, rate: float, outputs: Sequence[str]) -> dict[str, object]:
    """Return the table "gains" of a document with a rate, that with the smallest bounds.

    Raises:
        NoWitnessError: nothing is proven by gains at this rate.
    """
    found: list[tuple[float, dict[str, object]]] = []
    reason = NoWitnessError("nothing is tried")
    for taken in _rules_taken(loop):
        try:
            table, gains = _gains(loop, rate, outputs, taken)
        except NoWitnessError as error:
            reason = error
            continue
        decaying, constant = next(iter(gains.bounds.values()))
        found.append((float(decaying + constant), table))
    if not found:
        raise reason
    return min(found, key=lambda pair: pair[0])[1]


def _rules_taken(loop: Loop) -> Iterator[dict[str, object]]:
    """Yield what a table says about the rule for which that of the loop is taken."""
    if loop.times.longest > 0:
        yield {"by_time": True}
    if not loop.rule.integrates:
        yield {}
        return
    fastest = float(np.abs(np.linalg.eigvals(floats(loop.A + loop.B * loop.gain))).max()) or 1.0
    windows = (_AVERAGED / fastest).tolist()
    if not loop.times.sampling > 0:
        yield from ({"window_s": window} for window in windows)
        return
    sampling = float(loop.times.sampling.p) / float(loop.times.sampling.q)
    yield from (
        {"tests": tests} for tests in sorted({max(round(window / sampling), 1) for window in windows})
    )


def _gains(
    loop: Loop, rate: float, outputs: Sequence[str], taken: dict[str, object]
) -> tuple[dict[str, object], Gains]:
    """Return a table with a rate, and what it proves; see :func:`find_gains`."""
    is_periodic = loop.times.period > 0 or "by_time" in taken
    table: dict[str, object] = {
        **taken,
        "inputs": np.linalg.svd(floats(loop.gain))[0].T.tolist(),
        "outputs": list(dict.fromkeys(outputs)),
        "plant": _lyapunov(floats(loop.A + loop.B * loop.gain), rate, "A + BK"),
    }
    if loop.losses and not is_periodic and (rate or not loop.holds):
        table["model"] = _lyapunov(floats(loop.H), rate, "the model")
    try:
        text = as_text(gains_document(loop, rate, [*outputs], Naming("loop"))[0])
        document = Document(text)
        if not is_periodic and not document.compares_error:
            table["comparison"] = _comparison(loop)
        gains = Gains(document, read_proof(document, proof_text(text, table)))
    except (RejectedError, NoDocumentError) as error:
        raise NoWitnessError(f"gains: {error}") from None
    if compares_error(loop):
        table["inter_event_s"] = min(_inter_event_s(gains), before_due(loop))
    return table, gains


def find_by_gains(loop: Loop, outputs: Sequence[str]) -> dict[str, object]:
    """Return a document without quadratic forms, with the largest rate that is found.

    Raises:
        NoWitnessError: nothing is proven by gains.
    """
    if fault := loop.fault():
        raise NoWitnessError(fault)
    if loop.loads:
        raise NoWitnessError("model.load: gains do not cover loads, a search may")

    def at(rate: float) -> dict[str, object]:
        return {"rate": rate, "gains": find_gains(loop, rate, outputs)}

    largest, *smaller = rates_by_gains(loop)
    try:
        return at(largest)
    except NoWitnessError:
        if not smaller:
            raise
    slowest = at(smaller.pop())  # bounds grow with the rate: without any here there are none at a larger one
    for rate in smaller:
        with suppress(NoWitnessError):
            return at(rate)
    return slowest


def rates_by_gains(loop: Loop) -> Sequence[float]:
    """Return rates of decay that bounds by gains may have, from the largest one.

    Raises:
        NoWitnessError: the loop does not decay without losses.
    """
    closed, H = floats(loop.A + loop.B * loop.gain), floats(loop.H)
    falling = [closed] if loop.holds or not loop.losses else [closed, H]
    slowest = min([observer_decay(loop), *(-float(np.linalg.eigvals(M).real.max()) for M in falling)])
    level, threshold = float(loop.rule.level), float(loop.rule.rate)
    if slowest <= 0:
        raise NoWitnessError("the loop does not decay without losses")
    largest = 0.3 * slowest
    if level:
        largest = threshold if threshold < 0.95 * slowest else 0.8 * slowest
    if (loop.holds and loop.losses) or (level and not threshold):
        largest = 0.0
    return [*dict.fromkeys(share * largest for share in _SHARES)]


def _lyapunov(M: Matrix, rate: float, name: str) -> dict[str, object]:
    """Return P and ν with (M + r)ᵀP + P(M + r) ⪯ −2νP."""
    try:
        form, decay = lyapunov_decay(M, rate)
    except NotDecayingError as error:
        raise NoWitnessError(f"{name}: {error}") from None
    return {"form": form.tolist(), "decay": decay}


def _comparison(loop: Loop) -> dict[str, object]:
    """Return Y, J and S: the square of the rule's form on (x, e_s) is completed."""
    n, P, N = loop.n, floats(loop.rule.positive), floats(loop.rule.negative)
    if P.shape[1] != 2 * n:
        raise NoWitnessError("trigger.policy: gains need a rule that compares only x and e_s")
    Q = P.T @ P - N.T @ N
    of_errors, cross = Q[n:, n:], Q[n:, :n]
    values = np.linalg.eigvalsh(of_errors)
    if not values[0] > 1e-9 * abs(values[-1]):
        raise NoWitnessError("trigger: where the rule does not transmit, e_s may still have any size")
    Y = np.sqrt(1 - _SLACK) * np.linalg.cholesky(of_errors).T
    J = np.linalg.solve(of_errors, cross)
    values, vectors = np.linalg.eigh(cross.T @ J - Q[:n, :n])
    values = np.maximum(values, 0.0) + _SLACK * max(np.linalg.norm(Q[:n]), 1e-9 * np.linalg.norm(Q))
    share = np.sqrt(values)[:, None] * vectors.T
    return {"errors": Y.tolist(), "shift": J.tolist(), "share": share.tolist()}


def _inter_event_s(gains: Gains) -> float:
    """Return a time before which e_s does not reach the threshold after an event; 0 if none is found."""

    def share(time: float) -> float:
        return float(share_of_threshold(gains, number(time)))

    wanted, at_once, time = (1 + _NEARLY) / 2, share(0.0), _FIRST_S
    short, long = (0.0, at_once), (np.inf, np.inf)
    for _ in range(_STEPS if at_once < _NEARLY else 0):
        reached = share(time)
        if reached < 1:
            short = max(short, (time, reached))
        else:
            long = min(long, (time, reached))
        if _NEARLY < reached < 1 or short[0] == _LONGEST_S:
            break
        if np.isfinite(long[1]) and short[0]:  # between both
            time = short[0] + (long[0] - short[0]) * (wanted - short[1]) / (long[1] - short[1])
        else:
            time = min(time * (wanted - at_once) / max(reached - at_once, 1e-9), _LONGEST_S)
    return short[0]
