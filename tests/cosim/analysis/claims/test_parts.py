"""Claims about parts of runs: before and after changes of parameters, and up to a common stop."""

import math
from itertools import permutations
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation, RunClaims
from cosim.analysis.claims.run_evidence import trajectory_delta
from cosim.analysis.summary_model import ClaimVerdict
from cosim.record.align import AlignedRun, align_tables
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_SETTING,
    NO_SEQUENCE,
    OWNER,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.cosim.analysis.claims.conftest import MS, Make
from tests.cosim.record.changed_records import changed

CONTENT: dict[str, Any] = {
    "name": "changing",
    "horizon_s": 6.0,
    "model": {"name": "double_integrator"},
    "plant": {
        "initial_state": [1.0, 0.0],
        "rate_hz": 100.0,
        "draw": "uniform",
        "uncertainty_A": [[0.0, 0.0], [0.0, 0.1]],
    },
    "controller": {"rate_hz": 100.0},
    "trigger": {"beta": 0.05, "alpha_per_s": 0.2},
    "network": {"mansd": 1, "loss": {"model": "bernoulli", "probability": 0.3}},
}
STOP_NS = 3_003 * MS
APART_NS = 47 * MS


def run_with(*changes: tuple[float, dict[str, Any]], **more: Any) -> RunRecord:
    listed = [{"at_s": at_s, "set": settings} for at_s, settings in changes]
    return simulate(resolve(validate(CONTENT | {"changes": listed} | more, "here")))


def test_a_change_of_the_loss_alone_affects_no_claim() -> None:
    for changes in ((), ((2.0, {"network.loss.probability": 0.9}),)):
        record = run_with(*changes)
        claims = RunClaims(record).judge()
        assert claims == ClaimEvaluation(record).judge()
        assert {claim.verdict for claim in claims} == {ClaimVerdict.HELD}


def test_the_part_after_a_change_is_judged_as_a_separate_run() -> None:
    record = run_with((2.005, {"trigger.beta": 0.04, "network.mansd": 2}))
    claims = RunClaims(record).judge()
    deliveries = record[CONTROLLER_DELIVERY]["t_ns"]
    first_s = int(deliveries[deliveries >= 2_005_000_000][0]) / 1e9
    assert {(claim.from_s, claim.until_s) for claim in claims} == {(0.0, 2.005), (first_s, None)}
    assert {claim.verdict for claim in claims} == {ClaimVerdict.HELD}
    before, after = (
        [one for one in claims if (one.from_s > 0) is later and one.source == "certificate"]
        for later in (False, True)
    )
    assert [one.what for one in before] == [one.what for one in after]
    delta = {one.what: one.certified for one in after}["the controller's error is bounded"]
    # βe^{−αt} in the run's own time: the part's certificate starts from the threshold at that time.
    own = next(part for part in RunClaims(record).parts[1:] if isinstance(part, ClaimEvaluation))
    beta = 0.04 * np.exp(-0.2 * first_s)
    assert own.record.scenario.decaying.beta == pytest.approx(beta)
    envelope = own.certificates[0].controller_error(np.zeros(1))
    assert envelope == pytest.approx([delta * beta])
    # One more consecutive loss is allowed, so one more update may be missing.
    missing = [
        part.certificates[0].constants for part in RunClaims(record).parts
        if isinstance(part, ClaimEvaluation)
    ]  # fmt: skip
    assert missing[0] is not None
    assert missing[1] is not None
    assert missing[1].missing_events == missing[0].missing_events + 1


def test_a_plant_that_does_not_rest_at_the_set_point_has_a_constant_disturbance() -> None:
    plant = CONTENT["plant"] | {"uncertainty_A": [[0.0, 0.0], [0.3, 0.0]]}
    record = run_with((2.005, {"controller.setpoint": [3.0, 0.0]}), plant=plant)
    after = [one for one in RunClaims(record).judge() if one.from_s > 0]
    own = [one for one in after if one.source == "certificate"]
    assert own
    assert {one.verdict for one in own} == {ClaimVerdict.HELD}
    void = [one for one in after if one.verdict is ClaimVerdict.VOID]
    assert {one.source for one in void} == {"box certificate"}
    identity = next(one for one in after if one.source == "(I1)")
    assert identity.verdict is ClaimVerdict.HELD


def test_a_part_is_void_with_the_reason() -> None:
    late = run_with((5.995, {"trigger.beta": 0.04}))
    deaf = run_with((2.005, {"trigger.beta": 0.04}))
    deaf = changed(deaf, {CONTROLLER_SETTING: deaf[CONTROLLER_SETTING][:0]})
    far = run_with((2.005, {"trigger.beta": 1e-6}))
    for record, since_s, why in (
        (late, 5.995, "no update was delivered after it"),
        (deaf, 2.005, "not every process received the change"),
        (far, None, "from Kx"),
    ):
        after = [one for one in RunClaims(record).judge() if one.from_s > 0]
        void = [one for one in after if since_s or one.source == "certificate"]
        assert void
        for one in void:
            assert one.verdict is ClaimVerdict.VOID
            assert one.since_s == since_s or since_s is None
            assert why in one.why


# --- stopped runs --------------------------------------------------------------------------------


def stopped(record: RunRecord, reached_ns: dict[str, int]) -> RunRecord:
    """The record of the same run with its processes stopped at these times."""
    rows = {
        table: record[table][record[table]["now_ns"] <= reached_ns[OWNER[table]]]
        for table in record.tables
    }
    reports = {
        role: record.reports[role]
        | {"ended": "stopped by the user (SIGINT)", "reached_ns": reached_ns[role]}
        for role in LOOP_ROLES
    }
    return changed(record, rows, reports=reports, kind="live")


@pytest.mark.parametrize("order", [*permutations(LOOP_ROLES)][::5], ids="-".join)
def test_processes_that_stop_at_different_times_void_no_claim(
    run: RunRecord, order: tuple[str, ...]
) -> None:
    cut = stopped(run, {role: STOP_NS + i * APART_NS for i, role in enumerate(order)})
    if order[0] == "controller":  # the plant continues with its last input
        assert ClaimVerdict.VOID in {claim.verdict for claim in ClaimEvaluation(cut).judge()}
    claims = RunClaims(cut)
    verdicts = [(claim.source, claim.verdict) for claim in claims.judge()]
    assert len(verdicts) > 5
    assert {verdict for _, verdict in verdicts} == {ClaimVerdict.HELD}, verdicts
    assert claims.judged_until_s is not None
    assert 3.0 <= claims.judged_until_s <= STOP_NS * 1e-9


# --- Theorem 1's Δ from a recorded run: against its terms, and against the error that it bounds ---


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


def test_theorem_1_does_not_apply_without_events_or_with_a_weight(make: Make) -> None:
    quiet = make(trigger={"beta": 100.0}, network={"initial_sync": "known_state"})
    assert trajectory_delta(simulate(quiet)) is None
    record = simulate(make())
    weighted = make(trigger={"weight": [[2.0, 0.0], [0.0, 1.0]]})
    assert trajectory_delta(changed(record, scenario=weighted)) is None
    assert trajectory_delta(record) is not None
    assert record[SENSOR_MEASUREMENT]["t_ns"][1] == 10 * MS
