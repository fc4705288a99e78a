"""Theorem 1's Δ from a recorded run: against its terms, and against the error that it bounds."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim.analysis.claims.run_evidence import trajectory_delta, undominated
from cosim.record.align import AlignedRun, align_tables
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import NO_SEQUENCE, SENSOR_MEASUREMENT
from tests.cosim.analysis.claims.conftest import MS, Make, network_of
from tests.cosim.record.changed_records import changed


def delta_of(record: RunRecord) -> float | None:
    return trajectory_delta(record)


def by_hand(record: RunRecord, joined: AlignedRun, horizon: int = 10**9) -> float:
    """1 + Σ_k e^{αδ̃_k} sup‖e^{Hτ}‖ over the missing events after each event.

    Computed from the real intervals; the theorem's δ̄_j bound them from above.
    """
    from scipy.linalg import expm

    rows, alpha = record[SENSOR_MEASUREMENT], record.scenario.trigger.alpha_per_s
    at = np.flatnonzero(rows["event"] != NO_SEQUENCE)
    ends_s = [*(rows["t_ns"][at[1:]] * 1e-9), rows["t_ns"][-1] * 1e-9]
    largest = 1.0
    for k, start in enumerate(at):
        missing = [i for i in at[: k + 1] if rows["event"][i] > joined.received[start]]
        delta = 1.0
        for i in missing[-horizon:]:
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
    joined = align_tables(record)
    delta = trajectory_delta(record)
    assert delta is not None
    assert delta >= by_hand(record, joined) * (1 - 1e-6)
    trigger = record.scenario.trigger
    level = trigger.beta * np.exp(-trigger.alpha_per_s * joined.t_ns * 1e-9)
    known = joined.received >= 0
    # The theorem assumes a continuous trigger; this one is tested once a millisecond.
    overshoot = float((joined.e_s_norm / joined.threshold).max())
    assert overshoot < 1.2
    assert (joined.e_c_norm[known] <= overshoot * delta * level[known]).all()


def test_a_late_update_is_missing_exactly_until_it_arrives(make: Make) -> None:
    """Every update is 15 ms late, so two are never missing at once."""
    record = simulate(make(), network_of(lambda n: 15))
    joined = align_tables(record)
    starts = np.flatnonzero(record[SENSOR_MEASUREMENT]["event"] != NO_SEQUENCE)
    assert (joined.received[starts[1:]] == np.arange(len(starts) - 1)).all()
    delta, alone = trajectory_delta(record), by_hand(record, joined)
    assert delta is not None
    # Each stretch has one event; δ̄_j is a few times the real interval.
    assert alone < 4
    assert delta < 20


def test_no_event_is_missing_without_losses(make: Make) -> None:
    assert delta_of(simulate(make(), network_of(lambda n: 0))) == 1.0


def test_theorem_1_does_not_apply_without_events_or_with_a_weight(make: Make) -> None:
    quiet = make(trigger={"beta": 100.0}, network={"initial_sync": "known_state"})
    assert delta_of(simulate(quiet)) is None
    record = simulate(make())
    weighted = make(trigger={"weight": [[2.0, 0.0], [0.0, 1.0]]})
    assert delta_of(changed(record, scenario=weighted)) is None
    assert delta_of(record) is not None
    assert record[SENSOR_MEASUREMENT]["t_ns"][1] == 10 * MS


@given(st.lists(st.lists(st.floats(0.0, 10.0), min_size=1, max_size=4), min_size=1, max_size=40))
def test_the_stretches_that_are_left_out_are_exceeded_by_one_that_is_not(
    stretches: list[list[float]],
) -> None:
    def reaches(stretch: Sequence[float]) -> list[float]:
        sums = list(itertools.accumulate(reversed(stretch)))[::-1]
        return sums + [0.0] * (4 - len(sums))

    kept = undominated(stretches)
    for stretch in stretches:
        assert any(
            all(a >= b - 1e-9 for a, b in zip(reaches(one), reaches(stretch), strict=True))
            for one in kept
        )
    assert len(kept) <= len(stretches)
