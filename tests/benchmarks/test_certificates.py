"""The benchmark of the certificates with few loops: nothing is exceeded, and a mistake is."""

import pytest

from benchmarks.certificates import KINDS, examine

FEW = 6


@pytest.mark.parametrize("name", KINDS)
def test_no_bound_of_a_random_loop_is_exceeded(name: str) -> None:
    found = examine(KINDS[name], range(FEW))
    assert found.runs >= FEW
    assert found.violated[""] == 0
    assert max(found.closest.values()) > 0


@pytest.mark.parametrize("name", KINDS)
def test_some_broken_copy_is_detected(name: str) -> None:
    """Each one is detected by the benchmark, with more loops."""
    kind = KINDS[name]
    assert kind.broken
    assert any(examine(kind, range(FEW), broken).violated[""] for broken in kind.broken.values())
