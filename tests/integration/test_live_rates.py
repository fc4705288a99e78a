"""Live runs at rates whose periods are no whole number of nanoseconds."""

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import load_record
from tests.helpers.live_runs import run_scenario, settings


@pytest.mark.parametrize("rate_hz", [30, 144])
def test_a_live_run_keeps_the_rate_and_is_replayed_bit_for_bit(tmp_path: Path, rate_hz: int) -> None:
    finished = run_scenario(
        tmp_path, *settings(horizon_s=2.0, plant__rate_hz=rate_hz, controller__rate_hz=rate_hz)
    )  # fmt: skip
    record = load_record(finished.run_dir)
    steps = record["plant_step"]
    expected = [math.floor(k * Fraction(10**9, rate_hz) + Fraction(1, 2)) for k in range(2 * rate_hz + 1)]
    np.testing.assert_array_equal(steps["t_ns"], expected[: len(steps)])
    assert replay(record).bit_exact
