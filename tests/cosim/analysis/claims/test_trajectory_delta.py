"""Theorem 1's Δ from a recorded run: against its terms, and against the error that it bounds."""

import math

import numpy as np
import pytest

from cosim.analysis.claims.trajectory_delta import trajectory_delta
from cosim.record.align import AlignedRun, align_tables
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT
from tests.cosim.analysis.claims.conftest import MS, Make
from tests.cosim.record.changed_records import changed


def by_hand(record: RunRecord, samples: AlignedRun, horizon: int = 10**9) -> float:
    """1 + Σ_k e^{αδ̃_k} sup‖e^{Hτ}‖ over the missing events after each event.

    Computed from the real intervals; the theorem's δ̄_j bound them from above.
    """
    from scipy.linalg import expm

    rows, alpha = record[SENSOR_MEASUREMENT], record.scenario.trigger.alpha_per_s
    indices = np.flatnonzero(rows["event"] != NO_SEQUENCE)
    ends_s = [*(rows["t_ns"][indices[1:]] * 1e-9), rows["t_ns"][-1] * 1e-9]
    largest = 1.0
    for k, start in enumerate(indices):
        missing_indices = [i for i in indices[: k + 1] if rows["event"][i] > samples.received[start]]
        delta = 1.0
        for i in missing_indices[-horizon:]:
            reach_s = ends_s[k] - rows["t_ns"][i] * 1e-9
            grown = expm(record.loop.H * np.linspace(0, reach_s, 200)[:, None, None])
            delta += math.exp(alpha * reach_s) * np.linalg.norm(grown, 2, (1, 2)).max()
        largest = max(largest, delta)
    return largest


@pytest.mark.parametrize("mode", ["model", "zoh"])
@pytest.mark.parametrize("sync", ["first_packet", "known_state"])
def test_theorem_1_bounds_the_error_and_the_sum_over_the_real_intervals(
    mode: str, sync: str, make: Make
) -> None:
    fast = make(
        mode=mode, network={"initial_sync": sync, "loss": {"model": "worst_case"}},
        plant={"rate_hz": 1000.0}, controller={"rate_hz": 1000.0}, horizon_s=3.0,
    )  # fmt: skip
    record = simulate(fast)
    samples = align_tables(record)
    delta = trajectory_delta(record)
    assert delta is not None
    assert delta >= by_hand(record, samples) * (1 - 1e-6)
    trigger = record.scenario.trigger
    level = trigger.beta * np.exp(-trigger.alpha_per_s * samples.t_ns * 1e-9)
    known = samples.received >= 0
    # The theorem assumes a continuous trigger; this one is tested once a millisecond.
    overshoot = float((samples.e_s_norm / samples.threshold).max())
    assert overshoot < 1.2
    assert (samples.e_c_norm[known] <= overshoot * delta * level[known]).all()


def test_theorem_1_does_not_apply_without_events_or_with_a_weight(make: Make) -> None:
    quiet = make(trigger={"beta": 100.0}, network={"initial_sync": "known_state"})
    assert trajectory_delta(simulate(quiet)) is None
    record = simulate(make())
    weighted = make(trigger={"weight": [[2.0, 0.0], [0.0, 1.0]]})
    assert trajectory_delta(changed(record, scenario=weighted)) is None
    assert trajectory_delta(record) is not None
    assert record[SENSOR_MEASUREMENT]["t_ns"][1] == 10 * MS


def test_theorem_1_is_not_computed_for_long_delays(make: Make) -> None:
    """Δ has a term for each update in flight: over 200 at the end, fewer up to 2 s."""
    delay = {"impairments": [{"kind": "delay", "delay_s": 2.5}]}
    record = simulate(make(network=delay, trigger={"beta": 1e-9}))
    assert trajectory_delta(record, 2.0) is not None
    assert trajectory_delta(record) is None
