"""Certificates of random loops: no bound is exceeded, and those of broken copies are."""

import pytest

from tests.noack.theory.certificate_kinds.comparison import KINDS, examine

FEW = 6


@pytest.mark.parametrize("name", KINDS)
def test_no_bound_of_a_random_loop_is_exceeded(name: str) -> None:
    found = examine(KINDS[name], range(FEW))
    assert found.runs >= FEW
    assert found.violated[""] == 0
    assert max(found.closest.values()) > 0


@pytest.mark.parametrize("name", KINDS)
def test_some_broken_copy_is_detected(name: str) -> None:
    """The command line of ``certificate_kinds`` detects each one, with more loops."""
    kind = KINDS[name]
    assert kind.broken
    assert any(examine(kind, range(FEW), broken).violated[""] for broken in kind.broken.values())
