"""The judgement of a soak test; `.ci/run` makes one of five minutes."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from benchmarks.soak import Trend, constant, ended_badly, trend, warm_up_s

GOOD: dict[str, Any] = {
    "exit": {"status": 0, "reason": "horizon"},
    "missing_samples": 0,
    "unintended_losses": 0,
    "rejected_datagrams": {},
    "assumption_violations": [],
    "replay": {"bit_exact": True, "complete": True, "inputs": 7},
    "claims": [
        {"verdict": "held", "since_s": None, "what": "a", "source": "b", "why": ""},
        {"verdict": "not applicable", "since_s": 1.0, "what": "a", "source": "b", "why": "ideal"},
        {"verdict": "void", "since_s": 1.0, "what": "a", "source": "b", "why": "late"},
    ],
}


def summary(**changed: Any) -> dict[str, Any]:
    """The summary of a good run of one loop, with other values."""
    end = {"exit": changed.pop("exit", GOOD["exit"])}
    return end | {"loops": [GOOD | changed]}


def test_stale_rejections_must_equal_the_packets_delivered_out_of_order() -> None:
    assert not [*ended_badly(summary(), 0)]
    stale = summary(rejected_datagrams={"controller": {"stale": 3}})
    assert [len([*ended_badly(stale, 0, number)]) for number in (3, 0, 2)] == [0, 1, 1]


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("exit", {"status": 1, "reason": "plant: too slow"}, "too slow"),
        ("missing_samples", 3, "missing_samples: 3"),
        ("unintended_losses", 1, "unintended_losses: 1"),
        ("rejected_datagrams", {"plant": {"tag": 1}}, "rejected_datagrams"),
        ("assumption_violations", [{"cause": "dropouts", "what": "MANSD violated"}], "MANSD"),
        ("replay", {"bit_exact": False, "complete": True, "inputs": 7}, "the replay"),
        ("replay", None, "the replay"),
        ("claims", [], "no claim"),
        ("claims", [GOOD["claims"][1] | {"verdict": "violated"}], "violated since 1.0 s"),
    ],
)
def test_each_fault_in_the_summary_is_reported(key: str, value: object, told: str) -> None:
    faults = [*ended_badly(summary(**{key: value}), 0)]
    assert len(faults) == 1
    assert told in faults[0]


HOUR_S = 3600.0
LEAK_KIB_PER_S = 500 * 88 / 1024
"""Of 88 bytes a step."""


def noise(t: float) -> float:
    """Return an allocator's fluctuation: ± 300 KiB, faster than a window."""
    return 300 * math.sin(t) * math.cos(0.37 * t)


def judged(kib_of_s: Callable[[float], float], length_s: float = HOUR_S) -> Trend:
    at_s = np.arange(0.0, length_s, 5.0 if length_s <= HOUR_S else 60.0)
    return trend(at_s.tolist(), [80_000.0 + kib_of_s(t) for t in at_s], length_s)


@pytest.mark.parametrize(
    ("kib_of_s", "length_s", "verdict"),
    [
        (noise, HOUR_S, "flat"),
        (lambda t: 50 * min(t, 300.0), HOUR_S, "flat"),  # the warm-up is not judged
        (lambda t: 20_000 if t % 600 < 60 else 0, HOUR_S, "flat"),  # temporary memory
        (lambda t: noise(t) + 500 * t * 2 / 1024, HOUR_S, "grows"),  # two bytes a step
        (lambda t: 0.1 * t, HOUR_S, "creeps"),  # 0.8 events per second, 128 bytes each
        # Five minutes suffice for a leak per step but not for slower leaks, a minute for none.
        (lambda t: LEAK_KIB_PER_S * t, 300.0, "grows"),
        (lambda t: 0.1 * t, 300.0, "flat"),
        (lambda t: LEAK_KIB_PER_S * t, 60.0, "too short"),
        # A longer run is judged by its growth rate.
        (lambda t: noise(t) + 0.2 * t, 24 * HOUR_S, "creeps"),
        (lambda t: noise(t) + 0.4 * t, 24 * HOUR_S, "grows"),
    ],
)
def test_the_trend_of_memory(kib_of_s: Callable[[float], float], length_s: float, verdict: str) -> None:
    assert judged(kib_of_s, length_s).verdict == verdict


def test_the_numbers_of_a_trend() -> None:
    found = judged(lambda t: noise(t) + LEAK_KIB_PER_S * t)
    assert found.slope_kib_per_h == pytest.approx(3600 * LEAK_KIB_PER_S, rel=0.1)
    found = judged(lambda t: t - 80_000)
    assert (found.at_10_kib, found.at_50_kib, found.at_100_kib) == (360.0, 1800.0, 3595.0)
    assert warm_up_s(HOUR_S) == 300.0
    assert trend([0.0, 900.0, 1800.0], [1.0] * 3, HOUR_S).verdict == "unknown"  # too few samples
    assert trend([], [], HOUR_S).verdict == "unknown"


def test_changes_of_a_count_are_found_after_the_warm_up_only() -> None:
    at_s = [30.0, 40.0, 70.0, 80.0, 99.0]
    assert constant(at_s, [9, 9, 7, 7, 7], 100.0) == (7, 9)
    assert constant(at_s, [7, 7, 8, 7, 7], 100.0) == (7, 7)
    assert constant([0.0, *at_s[1:]], [3, 7, 7, 7, 7], 100.0) == (7, 7)
