"""Times between events by gains: a run nearly has them, and each condition counts."""

import copy
import itertools
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import fmpq

from noack.core.balls import beside, identity, matrix, number, square, zeros
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from noack.theory.witnesses.documents import witness_by_gains
from noack_gains.apart import _sum_of_vectors, reached, share_of_threshold
from tests.checker.loops import IDEAL, NOISE, SCHEDULE, changed, scalar, steady
from tests.checker.proofs import gains_of
from tests.checker.shortest import shortest_times

_NEAR = 0.97
"""The share of the least time of a run that is proven, at least."""


def proven(loop: Loop) -> tuple[dict[str, Any], Proof]:
    witness = witness_by_gains(loop, ("x", "e_s", "e_c"))
    return dict(witness.document), witness.proof


def exactly(value: float) -> fmpq:
    """Return the decimal of a float, as a proof has it."""
    return fmpq(*Fraction(repr(value)).as_integer_ratio())


def least_time(loop: Loop) -> float:
    """Return the least time between two events of a run, but for those of the one at t = 0."""
    return shortest_times(loop).any


@pytest.mark.parametrize(
    "loop",
    [
        steady(0, disturbance=1.0),
        steady(1),
        steady(2),
        steady(5),
        steady(2, level=1.1),
        steady(0, disturbance=1.0)._replace(noise=NOISE),
    ],
    ids=[
        "a disturbance",
        "one loss",
        "two losses",
        "five losses",
        "a threshold with a kink",
        "noise",
    ],
)
def test_a_run_nearly_has_the_least_time(loop: Loop) -> None:
    """So 1.05 times the proven one is false, and rejected."""
    document, proof = proven(loop)
    assert proof.inter_event is not None
    shortest, stated = least_time(loop), float(proof.inter_event)
    assert _NEAR * shortest < stated <= shortest
    document = copy.deepcopy(document)
    document["gains"]["inter_event_s"] *= 1.05
    assert document["gains"]["inter_event_s"] > shortest
    with pytest.raises(RejectedError, match="an event may come earlier"):
        prove_statement(loop, document)


@pytest.mark.parametrize(
    ("loop", "lie"),
    [
        (steady(2), steady(1)),
        (steady(0, disturbance=1.0), steady(0, disturbance=0.8)),
        (
            steady(0, times=IDEAL._replace(delay=fmpq(1, 2))),
            steady(0, times=IDEAL._replace(delay=fmpq(1, 20))),
        ),
        (steady(0, disturbance=1.0)._replace(noise=NOISE), steady(0, disturbance=1.0)),
    ],
    ids=["a loss", "a disturbance", "a delay", "noise"],
)  # fmt: skip
def test_a_time_for_less_is_not_one_for_more(loop: Loop, lie: Loop) -> None:
    true, false = proven(loop)[1].inter_event, proven(lie)[0]["gains"]["inter_event_s"]
    assert true is not None
    assert float(true) <= least_time(loop) < false
    document = copy.deepcopy(proven(loop)[0])
    document["gains"]["inter_event_s"] = false
    with pytest.raises(RejectedError, match="an event may come earlier"):
        prove_statement(loop, document)


def test_errors_of_older_lost_updates_have_fallen() -> None:
    """They are at least 0, 1, 2 times the proven time old. In a run they are older, at the first losses."""
    loop = steady(3)._replace(gain=number(-0.7) * identity(1))
    document, proof = proven(loop)
    stated = document["gains"]["inter_event_s"]
    assert proof.inter_event == exactly(stated)
    assert 0.85 * least_time(loop) < stated <= least_time(loop)
    (gains,) = (unit for unit in gains_of(loop, {**document, "rate": 0.0}).units)
    young, old = (float(gains.value(gains.lost("p 0", number(time)))) for time in (0.0, stated))
    decay = [math.exp(-0.4 * k * stated) for k in range(3)]
    assert old / young == pytest.approx(sum(decay) / 3, rel=1e-3)


def test_of_events_that_never_come_a_time_with_a_meaning_is_stated() -> None:
    """Without losses, and with a model that is the plant, nothing moves e_s."""
    document, proof = proven(scalar(0, IDEAL))
    assert document["gains"]["inter_event_s"] == 1e9
    assert proof.inter_event == 10**9


def test_both_parts_of_a_threshold_do_not_count_at_its_kink() -> None:
    """There v = 0.1, and 9v + 1 is what two units make of a threshold of 1."""
    loop = steady(2, level=10.0)
    document, _ = proven(loop)
    gains = gains_of(loop, document)
    time = number(document["gains"]["inter_event_s"])
    assert gains.single is not None
    assert share_of_threshold(gains, time) < 1
    sizes = {unit.unit.has_start: float(reached(unit, time)) for unit in gains.units}
    assert 0.1 * sizes[True] + sizes[False] > 1.8


def test_vectors_add_up_to_at_most_what_signs_can_make_of_them() -> None:
    rng = np.random.default_rng(5)
    for n, k in itertools.product((1, 2, 3), (1, 2, 3, 5)):
        columns, sizes = rng.normal(size=(n, k)), rng.uniform(0, 1, k)
        most = max(
            np.linalg.norm(columns @ (sizes * signs)) for signs in itertools.product((-1.0, 1.0), repeat=k)
        )
        lengths = float(np.linalg.norm(columns, axis=0) @ sizes)
        found = float(_sum_of_vectors(square(matrix(columns.tolist())), [number(each) for each in sizes]))
        assert most * (1 - 1e-12) <= found <= lengths * (1 + 1e-12)
        if k < 3:
            assert found == pytest.approx(most)


# Events are at tests.


def test_the_next_test_after_silent_ones_is_the_first_that_may_be_an_event() -> None:
    loop = scalar(0, SCHEDULE._replace(sampling=fmpq(1, 50), least_sampling=fmpq(1, 50)))
    document, proof = proven(loop)
    stated, tests = document["gains"]["inter_event_s"], proof.inter_event
    assert tests is not None
    assert 1 / 50 < stated < float(tests) < stated + 1 / 50
    assert (50 * tests).q == 1
    nearer = prove_statement(changed(loop, least_sampling=fmpq(1, 51)), document).inter_event
    assert nearer == max(exactly(stated), fmpq(50, 51) * tests)
    far = changed(loop, least_sampling=fmpq(1, 500))
    assert prove_statement(far, document).inter_event == exactly(stated)


def test_without_a_comparison_events_are_as_far_apart_as_tests() -> None:
    relative = scalar(0, SCHEDULE)
    relative = relative._replace(
        rule=relative.rule._replace(negative=number(0.05) * beside(identity(1), zeros(1, 1)))
    )
    assert proven(relative)[1].inter_event == SCHEDULE.least_sampling
    assert proven(relative._replace(times=IDEAL))[1].inter_event is None
    held = changed(relative, dwell=fmpq(1, 5))
    assert proven(held)[1].inter_event == fmpq(1, 5)
