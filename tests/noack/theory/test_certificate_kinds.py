"""Certificates of random loops: no bound is exceeded, and those of each broken copy are."""

import pytest

from tests.noack.theory.certificate_kinds.comparison import KINDS, examine

FEW, MOST = 6, 60
LOOPS = dict.fromkeys(KINDS, FEW) | {"decaying": 40, "continuous time": 20}
BROKEN = [(name, mistake) for name, kind in KINDS.items() for mistake in kind.broken]


@pytest.mark.parametrize("name", KINDS)
def test_no_bound_of_a_random_loop_is_exceeded(name: str) -> None:
    tally = examine(KINDS[name], range(LOOPS[name]))
    assert tally.runs >= FEW
    assert tally.violated[""] == 0
    assert max(tally.closest.values()) > 0


@pytest.mark.parametrize(("name", "mistake"), BROKEN)
def test_each_broken_copy_is_detected(name: str, mistake: str) -> None:
    """Within 60 loops in which the mistake matters; true certificates stand in the same loop."""
    kind = KINDS[name]
    broken = kind.broken[mistake]
    for seed in range(MOST):
        if examine(kind, range(seed, seed + 1), broken).violated[""]:
            true = broken._replace(certify=kind.certify)
            assert examine(kind, range(seed, seed + 1), true).violated[""] == 0
            return
    pytest.fail("no run exceeds it")
