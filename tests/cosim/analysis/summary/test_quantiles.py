"""Quantiles of many values, against those of the sorted values."""

import numpy as np
import pytest

from cosim.analysis.summary.quantiles import EXACT, RESOLUTION, QuantileSketch


def test_quantiles_of_many_values_have_the_stated_error() -> None:
    values = np.random.default_rng(1).lognormal(3, 2, EXACT + 5000)
    values[:1000] *= -1
    sketch = QuantileSketch.of(np.array_split(values, 40))
    for share in (0.0, 0.0005, 0.01, 0.5, 0.99, 0.999, 0.999999):
        exact = float(np.quantile(values, share, method="lower"))
        assert sketch.quantiles(share)[0] == pytest.approx(exact, rel=RESOLUTION)
    assert sketch.quantiles(1.0)[0] == values.max()
    few = QuantileSketch.of(np.array_split(values[-5000:], 7))
    assert few.quantiles(0.99)[0] == np.quantile(values[-5000:], 0.99)
    assert QuantileSketch().quantiles(0.5) == [None]
