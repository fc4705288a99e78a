"""Responses from a time on, of which only the norms on cells are known; and which ones are shared."""

import math

import pytest
from flint import arb

from noack.core.balls import identity, matrix, number
from noack_gains.responses import Decay, EnclosedResponses, Question, enclose, responses

_ACCURACY = 2e-3
"""Of enclosed responses, relatively."""
LONGEST_S = 40.0
"""More than until the tail: what decays slowest is left."""


def question(off: float = 0.0) -> Question:
    """Two states that decay at 1/s and 3/s, seen alone and together, from a start of both."""
    M = matrix([[-1.0, off], [0.0, -3.0]])
    outputs = [matrix([[1.0, 0.0]]), matrix([[0.0, 1.0]]), identity(2)]
    return Question(M, Decay(identity(2), number(0.5)), outputs, [matrix([[1.0], [2.0]])])


@pytest.mark.parametrize("time", [0.0, 1e-30, 0.01, 0.37, 1.5, 4.0])
def test_responses_from_a_time_on_are_those_of_the_closed_form(time: float) -> None:
    found = EnclosedResponses(question(), 1e-6).after(number(time))
    slow, fast = math.exp(-time), 2 * math.exp(-3 * time)
    for (response,), size, total in zip(found, (slow, fast), (slow, fast / 3), strict=False):
        assert size <= float(response.most) * (1 + 1e-15)
        assert total <= float(response.total) * (1 + 1e-15)
    ((of_slow,), _, (of_both,)) = found
    assert float(of_slow.most) <= slow * (1 + _ACCURACY)
    assert float(of_slow.total) <= slow * (1 + _ACCURACY)
    assert math.hypot(slow, fast) <= float(of_both.most) <= math.hypot(slow, fast) * (1 + _ACCURACY)


def test_after_the_last_cell_responses_fall_as_the_form_does() -> None:
    ((response,), *_) = EnclosedResponses(question()).after(number(LONGEST_S))
    assert math.exp(-LONGEST_S) <= float(response.most) <= math.exp(-0.5 * (LONGEST_S - 15))
    assert float(response.total) == pytest.approx(2 * float(response.most))


def test_a_time_that_is_not_exact_counts_from_its_earliest_on() -> None:
    enclosed = EnclosedResponses(question())
    early, exact = enclosed.after(arb(1.0, 0.25)), enclosed.after(number(0.75))
    for (found,), (expected,) in zip(early, exact, strict=True):
        assert float(found.total) == pytest.approx(float(expected.total), rel=1e-6)


def test_only_questions_of_the_same_numbers_share_an_answer() -> None:
    assert enclose(question(), 1e-3) is enclose(question(), 1e-3)
    assert enclose(question(math.ulp(0.0)), 1e-3) is not enclose(question(), 1e-3)
    asked = question()
    apart = Question(asked.M, asked.decay, asked.outputs[:1], [*asked.outputs[1:], *asked.inputs])
    together = Question(asked.M, asked.decay, asked.outputs, asked.inputs)
    assert apart != together
    assert asked == together
    unknown = [Question(asked.M * arb("nan"), asked.decay, asked.outputs, asked.inputs) for _ in range(2)]
    assert unknown[0] != unknown[1]


def test_the_answer_over_all_times_is_that_from_0_on() -> None:
    asked = question()
    found = responses(asked.M, asked.decay, asked.outputs, asked.inputs)
    for row, other in zip(found, EnclosedResponses(asked).after(arb(0)), strict=True):
        assert [float(response.total) for response in row] == [float(response.total) for response in other]
