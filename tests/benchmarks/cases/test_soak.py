"""The check of a soak test; `.ci/run` makes one of three minutes."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.cases.soak import Trend, end_rows, lasting_range, memory_trend, warm_up_s
from benchmarks.report import MeasurementError

GOOD: dict[str, Any] = {
    "missing_samples": 0,
    "unintended_losses": 0,
    "rejected_datagrams": {},
    "violations": [],
    "longest_loss_burst": 3,
    "replay": {"bit_exact": True, "complete": True, "inputs": 7},
    "claims": [
        {"verdict": "held", "what": "a", "source": "b"},
        {"verdict": "not applicable", "what": "a", "source": "b"},
        {"verdict": "ended", "what": "a", "source": "b"},
    ],
}


def faults(delivered_out_of_order: int = 0, status: int = 0, **changed: Any) -> list[str]:
    """The names of the rows that do not hold, of a good run of one loop with other values."""
    summary = {"exit": {"status": status, "reason": "plant: too slow"}, "loops": [GOOD | changed]}
    return [row.name for row in end_rows(summary, delivered_out_of_order) if row.holds is False]


def test_stale_rejections_must_equal_the_packets_delivered_out_of_order() -> None:
    assert not faults()
    stale = {"controller": {"stale": 3}}
    assert [len(faults(number, rejected_datagrams=stale)) for number in (3, 0, 2)] == [0, 1, 1]


@pytest.mark.parametrize(
    ("changed", "fault"),
    [
        ({"status": 1}, "exit status"),
        ({"missing_samples": 3}, "missing samples"),
        ({"unintended_losses": 1}, "unintended losses"),
        ({"rejected_datagrams": {"plant": {"tag": 1}}}, "rejected datagrams"),
        ({"violations": [{"cause": "dropouts"}]}, "loss bursts beyond the guarantee"),
        ({"replay": {"bit_exact": False, "complete": True}}, "replayed bit for bit and completely"),
        ({"replay": {"bit_exact": True, "complete": False}}, "replayed bit for bit and completely"),
        ({"replay": None}, "replayed bit for bit and completely"),
        ({"claims": []}, "claims checked"),
        ({"claims": [GOOD["claims"][1] | {"verdict": "violated"}]}, "claims violated"),
    ],
)
def test_each_fault_in_the_summary_is_reported(changed: dict[str, Any], fault: str) -> None:
    assert faults(**changed) == [fault]


HOUR_S = 3600.0
LEAK_KIB_PER_S = 500 * 88 / 1024
"""Of 88 bytes a step."""


def noise(t: float) -> float:
    """Return an allocator's fluctuation: ± 300 KiB, faster than a window."""
    return 300 * math.sin(t) * math.cos(0.37 * t)


def checked_trend(kib_of_s: Callable[[float], float], length_s: float = HOUR_S) -> Trend:
    at_s = np.arange(0.0, length_s, 5.0 if length_s <= HOUR_S else 60.0)
    fitted = memory_trend(at_s.tolist(), [80_000.0 + kib_of_s(t) for t in at_s], length_s)
    assert fitted is not None
    return fitted


@pytest.mark.parametrize(
    ("kib_of_s", "length_s", "flat", "allowed_kib"),
    [
        (noise, HOUR_S, True, 1024),
        (lambda t: 50 * min(t, 300.0), HOUR_S, True, 1024),  # the warm-up is not checked
        (lambda t: 20_000 if t % 600 < 60 else 0, HOUR_S, True, 1024),  # temporary memory
        (lambda t: noise(t) + 500 * t * 2 / 1024, HOUR_S, False, 256),  # two bytes a step
        (lambda t: 0.1 * t, HOUR_S, False, 256),  # 0.8 events per second, 128 bytes each
        # Five minutes suffice for a leak per step but not for slower leaks.
        (lambda t: LEAK_KIB_PER_S * t, 300.0, False, 9728),
        (lambda t: 0.1 * t, 300.0, True, 9728),
        # A longer run is checked by its growth rate.
        (lambda t: noise(t) + 0.2 * t, 24 * HOUR_S, False, 256 * (24 - 1 / 12)),
        (lambda t: noise(t) + 0.05 * t, 24 * HOUR_S, True, 256 * (24 - 1 / 12)),
    ],
)
def test_memory_may_grow_by_its_noise_and_not_more(
    kib_of_s: Callable[[float], float], length_s: float, flat: bool, allowed_kib: float
) -> None:
    fitted = checked_trend(kib_of_s, length_s)
    assert fitted.allowed_kib == pytest.approx(allowed_kib)
    assert (fitted.growth_kib <= fitted.allowed_kib) == flat


def test_a_trend_needs_time_and_samples() -> None:
    fitted = checked_trend(lambda t: noise(t) + LEAK_KIB_PER_S * t)
    assert fitted.slope_kib_per_h == pytest.approx(3600 * LEAK_KIB_PER_S, rel=0.1)
    assert warm_up_s(HOUR_S) == 300.0
    assert memory_trend([0.0, 30.0], [1.0, 2.0], 60.0) is None
    with pytest.raises(MeasurementError, match="too rarely"):
        memory_trend([0.0, 900.0, 1800.0], [1.0] * 3, HOUR_S)


def test_changes_of_a_count_are_found_after_the_warm_up_only() -> None:
    at_s = [30.0, 40.0, 70.0, 80.0, 99.0]
    assert lasting_range(at_s, [9, 9, 7, 7, 7], 100.0) == (7, 9)
    assert lasting_range(at_s, [7, 7, 8, 7, 7], 100.0) == (7, 7)
    assert lasting_range([0.0, *at_s[1:]], [3, 7, 7, 7, 7], 100.0) == (7, 7)
