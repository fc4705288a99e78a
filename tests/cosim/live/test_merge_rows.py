from unittest.mock import patch

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from cosim.record.spool_conversion import Segment, merged

ROW = np.dtype([("input", "<i8"), ("value", "<f8")])


def batch(first: int, end: int) -> np.ndarray:
    rows = np.zeros(end - first, ROW)
    rows["input"] = np.arange(first, end)
    rows["value"] = 0.5 * rows["input"]
    return rows


def merge_rows(batches: list[np.ndarray]) -> np.ndarray:
    segments = [
        Segment(int(rows["input"].min()), int(rows["input"].max()), lambda rows=rows: rows)
        for rows in batches
        if len(rows)
    ]
    return np.concatenate([np.zeros(0, ROW), *merged(segments, ROW)])


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 12)), max_size=12), st.integers(1, 30))
def test_merged_rows_are_unique_and_ordered(ranges: list[tuple[int, int]], at_once: int) -> None:
    """Batches in any order, overlapping, repeated, empty; gaps stay gaps."""
    with patch("cosim.record.spool_conversion.BATCH_ROWS", at_once):
        rows = merge_rows([batch(first, first + n) for first, n in ranges])
    present = sorted({k for first, n in ranges for k in range(first, first + n)})
    assert rows["input"].tolist() == present
    assert rows["value"].tolist() == [0.5 * k for k in present]
    assert rows.dtype == ROW
