"""Fast operations on rows, against numpy and itertools."""

from itertools import groupby
from math import hypot

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from numpy.typing import NDArray

from netem.core.row_operations import all_entries, firsts_of_equal, largest_sizes, row_norms, set_rows

tables = arrays(np.float64, array_shapes(min_dims=2, max_dims=2, max_side=6), elements=st.floats())


@pytest.mark.parametrize("size", [1e300, 1e160, 1e-160, 1e-300, 5e-324])
def test_row_norms_neither_overflow_nor_vanish(size: float) -> None:
    rows = np.array([[3.0, 4.0], [0.0, -2.0], [0.0, 0.0]]) * size
    expected = [hypot(*row) for row in rows]
    np.testing.assert_allclose(row_norms(rows), expected, rtol=1e-12)
    # They equal numpy's where the squares do not overflow.
    safe = np.random.default_rng(1).normal(size=(100, 5)) * np.logspace(-130, 130, 100)[:, None]
    assert row_norms(safe).tobytes() == np.linalg.norm(safe, axis=1).tobytes()


@given(st.lists(st.integers(-1, 1)))
def test_consecutive_equal_values_begin_where_groupby_begins_a_group(values: list[int]) -> None:
    groups = [[place for place, _ in group] for _, group in groupby(enumerate(values), lambda pair: pair[1])]
    assert firsts_of_equal(np.array(values, np.int64)).tolist() == [places[0] for places in groups]


@given(tables)
def test_the_largest_size_of_a_row_is_nan_where_numpy_says_so(rows: NDArray[np.float64]) -> None:
    np.testing.assert_array_equal(largest_sizes(rows), np.abs(rows).max(axis=1))
    rows[0, -1] = np.nan
    assert np.isnan(largest_sizes(rows)[0])


@given(tables)
def test_something_holds_for_a_row_if_it_holds_for_every_entry(rows: NDArray[np.float64]) -> None:
    assert all_entries(rows > 0).tolist() == (rows > 0).all(axis=1).tolist()


@given(tables, st.data())
def test_rows_are_set_at_their_places_only(matrix: NDArray[np.float64], data: st.DataObject) -> None:
    numbers = st.lists(st.integers(0, len(matrix) - 1), unique=True)
    places = np.array(data.draw(numbers), np.intp)
    rows = np.random.default_rng(len(places)).normal(size=(len(places), matrix.shape[1]))
    expected = matrix.copy()
    expected[places] = rows
    set_rows(matrix, places, rows)
    assert matrix.tobytes() == expected.tobytes()
