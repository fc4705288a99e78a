"""The controller's states on the time grid of the measurements, from rows written by hand.

The model decays by 1 and by 3 per second, so that each state has a closed form.
"""

import math
from typing import Any

import numpy as np

from cosim.record.align import (
    AlignedRun,
    ControllerTrack,
    align_measurements,
    controller_track,
    initial_track,
    shares_update,
)
from cosim.record.run_record import Rows
from noack.protocol.record_tables import NO_SEQUENCE
from noack.scenario.resolution import LoopMatrices
from noack.scenario.scenario import Scenario
from tests.helpers.shipped import resolved

MS = 1_000_000
RATES = np.array([1.0, 3.0])
ZEROS, IDENTITY = np.zeros((2, 2)), np.eye(2)
LOOP = LoopMatrices(
    A_model=ZEROS,
    B_model=IDENTITY,
    K=ZEROS,
    H=-np.diag(RATES),
    A=ZEROS,
    B=IDENTITY,
    x0=np.zeros(2),
    weight=None,
    state_names=("a", "b"),
    input_names=("c", "d"),
)
START = ControllerTrack(np.zeros(1, np.int64), np.zeros((1, 2)), np.full(1, NO_SEQUENCE))
STATE = [("input", "<i8"), ("model_t_ns", "<i8"), ("x_c", "<f8", (2,))]
DELIVERY = [*STATE, ("sequence", "<i8")]
MEASUREMENT = [
    *((name, "<i8") for name in ("input", "t_ns", "event")),
    *((name, "<f8") for name in ("e_s_norm", "compared", "threshold")),
    *((name, "<f8", (2,)) for name in ("x", "x_s")),
]


def steps(*rows: tuple[int, int, list[float]]) -> Rows:
    """Ticks: number of the input, time of the model in ms, state."""
    return np.array([(number, t_ms * MS, x_c) for number, t_ms, x_c in rows], STATE)


def deliveries(*rows: tuple[int, int, list[float], int]) -> Rows:
    """Updates: as ticks, and the sequence number."""
    return np.array([(number, t_ms * MS, *rest) for number, t_ms, *rest in rows], DELIVERY)


def align(track: ControllerTrack, t_ms: list[int], until_ms: int = 1000, **more: Any) -> AlignedRun:
    """Align measurements of x = x_s = 0, without events."""
    rows = np.zeros(len(t_ms), MEASUREMENT)
    rows["t_ns"], rows["event"] = np.array(t_ms) * MS, NO_SEQUENCE
    rows["input"] = np.arange(len(t_ms))
    return align_measurements(LOOP, rows, track, until_ms * MS, **more)


def decayed(state: list[float], ms: float) -> np.ndarray:
    return np.array(state) * np.exp(-RATES * ms * 1e-3)


def scenario(initial_sync: str) -> Scenario:
    return resolved("double_integrator", f"network.initial_sync={initial_sync!r}")


TICKS = steps(
    (1, 10, [9.0, 9.0]),
    (3, 20, [1.5, 1.25]),
    (4, 40, [7.0, 7.0]),
    (6, 60, [0.5, 0.25]),
)
UPDATES = deliveries((2, 10, [2.0, 1.0], 0), (5, 50, [3.0, 4.0], 6))


def test_the_newest_state_is_propagated_to_each_measurement() -> None:
    aligned = align(controller_track(START, TICKS[:2], UPDATES[:1]), [0, 10, 15, 20, 27, 30], until_ms=29)
    expected = [
        [0.0, 0.0],
        [2.0, 1.0],  # the update comes after the tick of the same time
        decayed([2.0, 1.0], 5),
        [1.5, 1.25],
        decayed([1.5, 1.25], 7),
        [math.nan, math.nan],  # after the end of the track
    ]
    np.testing.assert_allclose(aligned.x_c, expected, rtol=1e-14)
    assert aligned.received.tolist() == [NO_SEQUENCE, 0, 0, 0, 0, NO_SEQUENCE]
    np.testing.assert_allclose(aligned.e_c_norm, np.linalg.norm(expected, axis=1), rtol=1e-14)


def test_sensor_and_controller_share_an_update_once_one_is_delivered() -> None:
    ticks, updates = steps(), deliveries((1, 10, [1.0, 1.0], 5), (2, 20, [1.0, 1.0], 6))
    track = controller_track(START, ticks, updates)
    for initial_sync, before_the_first in (("first_packet", False), ("known_state", True)):
        given = scenario(initial_sync)
        shared = shares_update(given, align(track, [0, 10, 20]))
        assert shared.tolist() == [before_the_first, True, True]


def test_the_controller_starts_from_the_known_state_or_from_0() -> None:
    known = scenario("known_state")
    assert not initial_track(scenario("first_packet")).x_c.any()
    assert initial_track(known).x_c[0].tolist() == [*known.plant.initial_state]
