import math

import numpy as np
import pytest

from benchmarks.soak.flat import constant, trend, warm_up_s

HOUR_S = 3600.0


def judged(kib_of_s, length_s: float = HOUR_S, every_s: float = 5.0):  # type: ignore[no-untyped-def]
    at_s = np.arange(0.0, length_s, every_s)
    return trend(at_s.tolist(), [float(kib_of_s(t)) for t in at_s], length_s)


def noise(t: float) -> float:
    """Return an allocator's fluctuation: ± 300 KiB, faster than a window."""
    return 300 * math.sin(t) * math.cos(0.37 * t)


def test_fluctuating_memory_is_flat() -> None:
    found = judged(lambda t: 80_000 + noise(t))
    assert found.verdict == "flat"
    assert abs(found.growth_kib) < 100


@pytest.mark.parametrize("bytes_per_step", [2.0, 10.0, 88.0])
def test_a_leak_per_step_is_reported_as_growth(bytes_per_step: float) -> None:
    found = judged(lambda t: 80_000 + noise(t) + 500 * t * bytes_per_step / 1024)
    assert found.verdict == "grows"
    assert found.slope_kib_per_h == pytest.approx(3600 * 500 * bytes_per_step / 1024, rel=0.1)


def test_a_leak_per_event_is_reported_as_slow_growth_after_an_hour() -> None:
    found = judged(lambda t: 80_000 + 0.1 * t)  # 0.8 events per second, 128 bytes each
    assert found.growth_kib < found.allowed_kib
    assert found.verdict == "creeps"


def test_five_minutes_suffice_for_a_leak_per_step_but_not_for_slower_leaks() -> None:
    assert judged(lambda t: 80_000 + 500 * t * 88 / 1024, 300.0).verdict == "grows"
    assert judged(lambda t: 80_000 + 0.1 * t, 300.0).verdict == "flat"


def test_one_minute_is_too_short_for_a_verdict() -> None:
    assert judged(lambda t: 80_000 + 500 * t * 88 / 1024, 60.0).verdict == "too short"


def test_the_warm_up_is_not_judged() -> None:
    assert warm_up_s(HOUR_S) == 300.0
    assert judged(lambda t: 80_000 + 50 * min(t, 300.0)).verdict == "flat"


def test_temporary_memory_is_not_growth() -> None:
    assert judged(lambda t: 80_000 + (20_000 if t % 600 < 60 else 0)).verdict == "flat"


def test_a_longer_run_is_judged_by_its_growth_rate() -> None:
    assert judged(lambda t: 80_000 + noise(t) + 0.2 * t, 24 * HOUR_S, 60.0).verdict != "grows"
    assert judged(lambda t: 80_000 + noise(t) + 0.4 * t, 24 * HOUR_S, 60.0).verdict == "grows"


def test_too_few_samples_give_no_verdict() -> None:
    assert judged(lambda t: 80_000, HOUR_S, 900.0).verdict == "unknown"
    assert trend([], [], HOUR_S).verdict == "unknown"


def test_memory_is_reported_at_shares_of_the_run() -> None:
    found = judged(lambda t: t)
    assert (found.at_10_kib, found.at_50_kib, found.at_100_kib) == (360.0, 1800.0, 3595.0)


def test_changes_of_a_count_are_found_after_the_warm_up_only() -> None:
    at_s = [0.0, 30.0, 70.0, 80.0, 99.0]
    assert constant([30.0, 40.0, *at_s[2:]], [9, 9, 7, 7, 7], 100.0) == (7, 9)
    assert constant([30.0, 40.0, *at_s[2:]], [7, 7, 8, 7, 7], 100.0) == (7, 7)
    assert constant(at_s, [3, 7, 7, 7, 7], 100.0) == (7, 7)
