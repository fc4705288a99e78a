"""A stopped run is judged up to the last time that all of its processes reached."""

from itertools import permutations

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.claims.claims_by_part import RunClaims, common_end_ns, up_to_common_end
from cosim.analysis.summary_model import ClaimVerdict
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import OWNER, SENSOR_MEASUREMENT
from noack.protocol.topology import LOOP_ROLES
from tests.cosim.analysis.claims.conftest import MS, Make

STOP_NS = 3_003 * MS
APART_NS = 47 * MS


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
    return RunRecord(record.scenario, rows, record.notices, reports, "live")


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
    record = RunRecord(quick, slow._rows, slow.notices, slow.reports)
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
        assert [life.hole_ns() for life in cut.lives(role)] == [None]


def test_a_complete_run_is_judged_to_its_end(run: RunRecord) -> None:
    assert common_end_ns(run) is None
    assert up_to_common_end(run) is run
    unknown = stopped(run, dict.fromkeys(LOOP_ROLES, STOP_NS))
    for report in (None, unknown.reports["netem"] | {"reached_ns": None}):
        reports = {**unknown.reports, "netem": report} if report else {
            role: unknown.reports[role] for role in LOOP_ROLES if role != "netem"
        }  # fmt: skip
        rows = {table: unknown[table] for table in unknown.tables}
        died = RunRecord(unknown.scenario, rows, [], reports)
        assert common_end_ns(died) is None
