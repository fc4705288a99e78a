"""The time until a process has recovered from a fault."""

import numpy as np
import pytest

from benchmarks.cases.faults import recovery_s


def test_a_process_has_recovered_once_no_step_is_late_for_a_while() -> None:
    assert recovery_s(np.array([2.4, 2.6, 2.7, 3.5]), 2.5) == pytest.approx(0.2)
    assert recovery_s(np.array([2.4, 3.5]), 2.5) == 0
