"""Curves with fewer points, as plotted on the screen."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cosim.record.decimation import decimate

VALUES = arrays(
    np.float64,
    st.integers(0, 300),
    elements=st.one_of(st.floats(-5, 5, width=16), st.just(np.nan)),
)


@given(VALUES, st.integers(1, 20), st.integers(0, 5))
def test_each_column_keeps_its_extremes_and_its_ends(y: np.ndarray, columns: int, step: int) -> None:
    """Compared column by column, as plotted on the screen."""
    t = np.cumsum(np.arange(len(y)) % (step + 1) + 0.5)
    keep = decimate(t, y, columns)
    assert np.array_equal(keep, np.unique(keep))
    if len(y) <= 4 * columns:
        assert len(keep) == len(y)
        return
    assert len(keep) <= 4 * columns
    column = np.minimum((t - t[0]) / (t[-1] - t[0]) * columns, columns - 1).astype(int)
    # Indices that rounding assigns to a neighbouring column are compared in neither.
    edge = np.abs((t - t[0]) / (t[-1] - t[0]) * columns - column) < 1e-9
    for c in np.unique(column):
        inside = (column == c) & ~edge
        kept = np.isin(np.arange(len(y)), keep) & (column == c)
        values = y[inside & np.isfinite(y)]
        if len(values):
            assert np.nanmin(y[kept]) <= values.min()
            assert np.nanmax(y[kept]) >= values.max()
    assert keep[0] == 0
    assert keep[-1] == len(y) - 1
