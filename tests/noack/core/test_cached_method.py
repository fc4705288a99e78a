"""Methods whose results are kept, by the bits of their arguments."""

import numpy as np

from noack.core.cached_method import cached_method


def test_a_method_takes_arrays_by_keyword_too() -> None:
    computed = list[float]()

    class Totals:
        @cached_method
        def total(self, values: np.ndarray) -> float:
            computed.append(float(values.sum()))
            return computed[-1]

    totals = Totals()
    assert [totals.total(values=np.full(4, entry)) for entry in (1.0, 1.0, 0.0)] == [4.0, 4.0, 0.0]
    assert computed == [4.0, 0.0]
