"""A search in the ascending numbers of a program's tables."""

from collections.abc import Sequence


def first_above(numbers: Sequence[int], begin: int, end: int, value: int) -> int:
    """Return the first place from ``begin`` on with a number above ``value``; else ``end``."""
    low, high = begin, end
    while low < high:
        middle = (low + high) // 2
        if numbers[middle] <= value:
            low = middle + 1
        else:
            high = middle
    return low
