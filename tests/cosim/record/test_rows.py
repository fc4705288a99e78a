"""Rows of a record: their parts by time."""

import numpy as np
import pytest

from cosim.record.rows import Rows, slices

_TIME = np.dtype([("now_ns", "<i8")])


def _rows(times_ns: np.ndarray) -> Rows:
    rows = np.zeros(len(times_ns), _TIME)
    rows["now_ns"] = times_ns
    return rows


@pytest.mark.parametrize("read_at_once", [1, 100, 30_000])
def test_parts_of_a_table_do_not_depend_on_how_it_is_read(read_at_once: int) -> None:
    """A part ends at the first row that is not before its end, although a later one may be."""
    rng = np.random.default_rng(0)
    times_ns = np.arange(30_000) * 10 + rng.integers(0, 500, 30_000)
    rows, width_ns = _rows(times_ns), 100_000
    pieces = (rows[i : i + read_at_once] for i in range(0, len(rows), read_at_once))
    found = [part["t"] for part in slices({"t": pieces}, {"t": rows[:0]}, width_ns)]
    assert np.concatenate(found).tobytes() == rows.tobytes()
    assert len(found) == 4
    for number, part in enumerate(found[:-1], 1):
        begin = sum(len(earlier) for earlier in found[:number])
        assert (part["now_ns"] < number * width_ns).all()
        assert times_ns[begin] >= number * width_ns
