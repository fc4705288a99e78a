import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.record import merge_rows

ROW = np.dtype([("number", "<i8")])


def batch(first: int, end: int) -> tuple[int, np.ndarray]:
    rows = np.zeros(end - first, ROW)
    rows["number"] = np.arange(first, end)
    return first, rows


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 12)), max_size=12))
def test_each_row_comes_once_and_in_order_and_gaps_are_told(ranges: list[tuple[int, int]]) -> None:
    """Batches in any order, overlapping, repeated, empty."""
    missing, rows = merge_rows([batch(first, first + n) for first, n in ranges], ROW)
    present = sorted({k for first, n in ranges for k in range(first, first + n)})
    assert rows["number"].tolist() == present
    assert rows.dtype == ROW
    told = [k for low, high in missing for k in range(low, high)]
    if present:
        assert [k for k in told if k < present[-1]] == sorted(
            set(range(present[-1])) - set(present)
        )


def test_gaps_are_half_open_ranges() -> None:
    missing, rows = merge_rows([batch(7, 9), batch(2, 4), batch(3, 5)], ROW)
    assert missing == [(0, 2), (5, 7)]
    assert rows["number"].tolist() == [2, 3, 4, 7, 8]


def test_nothing_merges_to_an_empty_table() -> None:
    missing, rows = merge_rows([], ROW)
    assert missing == []
    assert rows.shape == (0,)
    assert rows.dtype == ROW
