import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.soak.legs import MOST_WAITING, InTurn, Leg


def numbers(*values: int) -> "np.ndarray[tuple[int], np.dtype[np.int64]]":
    return np.array(values, dtype=np.int64)


@given(st.permutations(range(12)), st.lists(st.integers(1, 4), min_size=12, max_size=12))
def test_numbers_may_come_in_any_order_if_none_is_missing(
    order: list[int], sizes: list[int]
) -> None:
    turn, faults = InTurn("input"), []
    for size in sizes:
        batch, order = order[:size], order[size:]
        faults += turn.take(numbers(*sorted(batch)))
    assert [*faults, *turn.end()] == []
    assert (turn.next, turn.waiting) == (12, 0)


def test_a_missing_number_is_reported_at_the_end() -> None:
    turn = InTurn("input")
    assert list(turn.take(numbers(0, 1, 3, 4))) == []
    assert turn.next == 2
    assert list(turn.end()) == ["input 2 never came, but 3 and others did"]


def test_a_repeated_number_is_reported() -> None:
    turn = InTurn("input")
    assert list(turn.take(numbers(0, 1))) == []
    assert list(turn.take(numbers(1, 2))) == ["input 1 came twice"]
    assert turn.next == 3


def test_waiting_numbers_are_bounded() -> None:
    turn = InTurn("input")
    assert len(list(turn.take(1 + np.arange(MOST_WAITING + 1)))) == 1
    assert turn.waiting == 0


def both(sent: list[int], arrived: list[int]) -> list[str]:
    leg = Leg("update")
    leg.sent(numbers(*sent))
    leg.arrived(numbers(*arrived))
    return [*leg.judge(), *leg.end(0)]


def test_arrivals_may_be_reported_before_they_are_reported_as_sent() -> None:
    leg = Leg("update")
    leg.arrived(numbers(3))
    assert list(leg.judge()) == []
    leg.sent(numbers(3, 7))
    assert list(leg.judge()) == []
    assert leg.waiting == 1
    leg.arrived(numbers(7))
    assert list(leg.end(0)) == []


@pytest.mark.parametrize(
    ("sent", "arrived", "what"),
    [
        ([1, 2, 3], [1, 3], "update 2 was lost"),
        ([1, 2, 3], [1, 2, 2, 3], "update 2 came twice, or out of turn, or was not sent"),
        ([1, 2], [1], "update 2 and 0 more never came"),
        ([1], [1, 2], "update 2 came, but was not sent"),
    ],
)
def test_lost_repeated_and_unsent_packets_are_reported(
    sent: list[int], arrived: list[int], what: str
) -> None:
    assert both(sent, arrived) == [what]


def test_packets_in_flight_at_the_end_are_not_lost() -> None:
    leg = Leg("actuation")
    leg.sent(numbers(1, 2))
    assert list(leg.end(2)) == []
