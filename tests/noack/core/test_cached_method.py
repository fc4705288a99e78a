"""Functions whose results are kept, by the bits of their arguments."""

import numpy as np

from noack.core.cached_method import cached_function, cached_method


def test_latest_results_are_kept_by_the_bits_of_the_arguments() -> None:
    computed = list[tuple[float, int]]()

    @cached_function(2)
    def total(values: np.ndarray, *, factor: int = 1) -> float:
        computed.append((float(values.sum()), factor))
        return factor * float(values.sum())

    ones, row = np.ones(4), np.ones((1, 4))
    assert [total(ones, factor=3), total(np.ones(4), factor=3)] == [12.0, 12.0]
    assert computed == [(4.0, 3)]
    assert [total(ones), total(row, factor=3)] == [4.0, 12.0]  # of another factor, of another shape
    assert len(computed) == 3
    total(ones, factor=3)  # it was the oldest of three
    assert len(computed) == 4


def test_results_are_kept_by_a_key_of_the_arguments() -> None:
    @cached_function(2, key=len)
    def first(values: list[int]) -> int:
        return values[0]

    assert [first([1, 2]), first([3, 4]), first([5])] == [1, 1, 5]


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
