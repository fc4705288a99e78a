import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.record.run_record import merge_rows

ROW = np.dtype([("input", "<i8"), ("value", "<f8")])


def batch(first: int, end: int) -> np.ndarray:
    rows = np.zeros(end - first, ROW)
    rows["input"] = np.arange(first, end)
    rows["value"] = 0.5 * rows["input"]
    return rows


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 12)), max_size=12))
def test_merged_rows_are_unique_and_ordered(ranges: list[tuple[int, int]]) -> None:
    """Batches in any order, overlapping, repeated, empty; gaps stay gaps."""
    rows = merge_rows([batch(first, first + n) for first, n in ranges], ROW)
    present = sorted({k for first, n in ranges for k in range(first, first + n)})
    assert rows["input"].tolist() == present
    assert rows["value"].tolist() == [0.5 * k for k in present]
    assert rows.dtype == ROW


def test_merging_no_batches_gives_an_empty_table() -> None:
    rows = merge_rows([], ROW)
    assert rows.shape == (0,)
    assert rows.dtype == ROW
