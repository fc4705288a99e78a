"""Live runs at rates whose periods are no whole number of nanoseconds."""

import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.replay import replay
from cosim.record.run_record import load_run
from tests.helpers.live_runs import run_scenario, settings

pytestmark = pytest.mark.live


def test_loops_of_different_odd_rates_are_replayed_bit_for_bit(tmp_path: Path) -> None:
    rates = {"film": 30_000 / 1001, "display": 144.0, "camera": 90.0}
    loops = ", ".join(
        f'{{name="{name}", plant={{rate_hz={rate_hz!r}}}, controller={{rate_hz={rate_hz / (1 + number)!r}}}}}'
        for number, (name, rate_hz) in enumerate(rates.items())
    )
    finished = run_scenario(tmp_path, *settings(horizon_s=1.5), "--set", f"loops=[{loops}]")
    run = load_run(finished.run_dir)
    assert [*run.names] == [*rates]
    for record, rate_hz in zip(run.loops, rates.values(), strict=True):
        t_ns = record["plant_step"]["t_ns"]
        rate = Fraction(rate_hz).limit_denominator(2000)
        expected = [math.floor(k * 10**9 / rate + Fraction(1, 2)) for k in range(len(t_ns))]
        assert len(t_ns) > rate_hz
        np.testing.assert_array_equal(t_ns, expected)
        assert replay(record).bit_exact
