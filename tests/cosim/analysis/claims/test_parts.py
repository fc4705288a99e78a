"""Claims about parts of runs: before and after changes of parameters, and up to a common stop."""

from itertools import permutations
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import (
    ClaimEvaluation,
    RunClaims,
    _start_error,
    common_end_ns,
    up_to_common_end,
)
from cosim.analysis.summary_model import ClaimVerdict
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_SETTING,
    OWNER,
    PLANT_STEP,
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


def test_without_changes_the_claims_are_those_of_the_run() -> None:
    record = run_with()
    assert RunClaims(record).judge() == ClaimEvaluation(record).judge()


def test_a_change_of_the_loss_alone_affects_no_claim() -> None:
    claims = RunClaims(run_with((2.0, {"network.loss.probability": 0.9}))).judge()
    assert {(claim.from_s, claim.until_s) for claim in claims} == {(0.0, None)}
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


def test_claims_at_a_set_point_concern_the_deviations() -> None:
    claims = RunClaims(run_with((2.005, {"controller.setpoint": [3.0, 0.0]}))).judge()
    after = [one for one in claims if one.from_s > 0]
    assert {one.verdict for one in after} == {ClaimVerdict.HELD}
    assert any(one.source == "box certificate" for one in after)


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


def test_nothing_is_judged_before_a_set_point_that_applies_from_the_start() -> None:
    # Deviations from the wrong set-point never decay.
    record = run_with((0.0, {"controller.setpoint": [3.0, 0.0]}), horizon_s=12.0)
    (first, own) = RunClaims(record).parts
    assert isinstance(own, ClaimEvaluation)
    assert np.abs(own.record[PLANT_STEP]["x"][-1]).max() < 0.05
    assert np.abs(record[PLANT_STEP]["x"][-1]).max() > 2.9
    assert isinstance(first, ClaimEvaluation)
    assert first.judge() == [] or all(one.ratio is None for one in first.judge())


def test_a_part_without_a_delivery_is_void_with_the_reason() -> None:
    record = run_with((5.995, {"trigger.beta": 0.04}))
    (last,) = [one for one in RunClaims(record).judge() if one.from_s > 0]
    assert last.verdict is ClaimVerdict.VOID
    assert (last.from_s, last.until_s, last.since_s) == (5.995, None, 5.995)
    assert "no update was delivered after it" in last.why


def test_claims_are_void_if_a_process_did_not_receive_a_change() -> None:
    record = run_with((2.005, {"trigger.beta": 0.04}))
    deaf = changed(record, {CONTROLLER_SETTING: record[CONTROLLER_SETTING][:0]})
    (last,) = [one for one in RunClaims(deaf).judge() if one.from_s > 0]
    assert "not every process received the change" in last.why


def test_an_input_too_far_from_kx_voids_the_certificate() -> None:
    record = run_with((2.005, {"trigger.beta": 1e-6}))
    after = [one for one in RunClaims(record).judge() if one.from_s > 0]
    void = [one for one in after if one.source == "certificate"]
    assert {one.verdict for one in void} == {ClaimVerdict.VOID}
    assert all("from Kx" in one.why for one in void)


def test_the_input_error_at_the_start_is_that_of_the_plants_steps() -> None:
    record = run_with()
    loop, steps = record.loop, record[PLANT_STEP]
    u, x = steps["u"][:20], steps["x"][:21]
    worst = max(
        float(np.linalg.norm(u[i] - loop.K @ x[j]) * np.exp(0.2 * 0.01 * (i + 1)))
        for i in range(20) for j in (i, i + 1)
    )  # fmt: skip
    found = _start_error(record, 0.2)
    assert worst <= found <= 1.01 * worst


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
    claims = RunClaims(cut)
    verdicts = [(claim.source, claim.verdict) for claim in claims.judge()]
    assert len(verdicts) > 5
    assert {verdict for _, verdict in verdicts} == {ClaimVerdict.HELD}, verdicts
    assert claims.judged_until_s is not None
    assert 3.0 <= claims.judged_until_s <= STOP_NS * 1e-9


def test_the_time_beyond_the_common_end_would_void_claims(run: RunRecord) -> None:
    """The controller stops first; the plant continues with its last input."""
    times = dict.fromkeys(LOOP_ROLES, STOP_NS + APART_NS) | {"controller": STOP_NS}
    cut = stopped(run, times)
    assert ClaimVerdict.VOID in {claim.verdict for claim in ClaimEvaluation(cut).judge()}
    assert ClaimVerdict.VOID not in {claim.verdict for claim in RunClaims(cut).judge()}


def test_a_violation_before_the_stop_voids_the_claims(make: Make) -> None:
    """The certificate assumes an input age of at most 10 ms; the controller's period is 50 ms."""
    scenario = make(controller={"rate_hz": 20.0}, certificate={"late_periods": 0})
    slow = simulate(scenario)
    quick = scenario.model_copy(
        update={"controller": scenario.controller.model_copy(update={"rate_hz": 100.0})}
    )
    record = changed(slow, scenario=quick)
    cut = stopped(record, dict.fromkeys(LOOP_ROLES, STOP_NS))
    assert ClaimVerdict.VOID in {claim.verdict for claim in RunClaims(cut).judge()}


def test_rows_of_every_table_end_with_their_process(run: RunRecord) -> None:
    times = dict.fromkeys(LOOP_ROLES, STOP_NS + APART_NS) | {"sensor": STOP_NS}
    cut = up_to_common_end(stopped(run, times))
    end_ns = cut[SENSOR_MEASUREMENT]["t_ns"][-1]
    for table in cut.tables:
        rows, whole = cut[table], run[table]
        assert len(rows) < len(whole) or not len(whole)
        assert np.array_equal(rows, whole[: len(rows)])
        # with the time of the model state used for the input
        if table != "plant_actuation" and len(rows):
            assert rows["now_ns"][-1] <= end_ns + 10 * MS
    for role in LOOP_ROLES:
        assert [life.hole_ns for life in cut.lives(role)] == [None]


def test_a_complete_run_is_judged_to_its_end(run: RunRecord) -> None:
    assert common_end_ns(run) is None
    assert up_to_common_end(run) is run
    unknown = stopped(run, dict.fromkeys(LOOP_ROLES, STOP_NS))
    for report in (None, unknown.reports["netem"] | {"reached_ns": None}):
        reports = {**unknown.reports, "netem": report} if report else {
            role: unknown.reports[role] for role in LOOP_ROLES if role != "netem"
        }  # fmt: skip
        assert common_end_ns(changed(unknown, reports=reports)) is None
