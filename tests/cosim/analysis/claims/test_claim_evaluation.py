"""Claims against runs, with changes and stopped: held, violated or ended; random runs violate none."""

import re
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims import claim_catalogue
from cosim.analysis.claims.claim_catalogue import CERTIFIED_AND_IDENTITY, PAPER
from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.summary.summary_model import Claim, ClaimCause, ClaimKind, ClaimVerdict
from cosim.record.align import aligned_parts
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    CONTROLLER_STEP,
    OWNER,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)
from noack.protocol.roles import LOOP_ROLES
from noack.protocol.wire_format import read_header
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.cosim.analysis.claims.conftest import MS, Make, event_s, without
from tests.cosim.record.changed_records import CONTENT as CHANGING
from tests.cosim.record.changed_records import changed
from tests.helpers.shipped import resolved
from tests.oracles.random_scenarios import random_scenario

HELD, VIOLATED, ENDED = ClaimVerdict.HELD, ClaimVerdict.VIOLATED, ClaimVerdict.ENDED

CERTIFIED = (
    "the sensor's error is bounded",
    "the controller's error is bounded",
    "the state is bounded",
    "minimum inter-event time",
)


def certified(record: RunRecord) -> dict[str, Claim]:
    return {c.what: c for c in RunClaims(record).evaluate() if c.source == "certificate"}


DOCS = Path(__file__).parents[4] / "docs" / "record.md"


def test_the_docs_list_every_claim_of_the_catalogue() -> None:
    text = Path(claim_catalogue.__file__).read_text(encoding="utf-8")
    defined = len(re.findall(r"^@(?:identity|of_paper|certified)\(", text, re.MULTILINE))
    rows = {(claim.statement, claim.source, claim.assumes) for claim in (*CERTIFIED_AND_IDENTITY, *PAPER)}
    assert len(rows) == defined
    text = DOCS.read_text(encoding="utf-8")
    section = text[text.index("\n## Claims") : text.index("\n## The summary")]
    table_rows = [line.strip("| ").split(" | ") for line in section.splitlines() if " | " in line]
    of_guarantee = (
        "each rule of the guarantee, as *at most 4 lost in a row*",
        "network",
        "nothing",
    )
    assert {tuple(cells) for cells in table_rows[1:]} == {*rows, of_guarantee}


# --- held -----------------------------------------------------------------------------------------


def test_certified_claims_hold_in_a_run_that_meets_its_schedule(run: RunRecord) -> None:
    assert {c.what: c.verdict for c in certified(run).values()} == dict.fromkeys(CERTIFIED, HELD)
    for claim in RunClaims(run).evaluate():
        assert claim.since_s is None
        assert claim.ratio is not None
        assert 0 <= claim.ratio <= 1
        if claim.certified is not None and claim.what != "minimum inter-event time":
            assert claim.observed == pytest.approx(claim.certified * claim.ratio)


def test_the_observed_value_is_the_smallest_bound_that_would_hold(run: RunRecord) -> None:
    """Computed from the recorded tables, not from the aligned ones."""
    claims, rows = certified(run), run[SENSOR_MEASUREMENT]
    trigger = run.scenario.trigger
    growth = np.exp(trigger.alpha_per_s * rows["t_ns"] * 1e-9)
    errors = np.linalg.norm(rows["x_s"] - rows["x"], axis=1) * growth
    assert claims[CERTIFIED[0]].observed == pytest.approx(errors.max(), rel=1e-6)
    sizes = np.linalg.norm(rows["x"], axis=1) * growth
    assert claims[CERTIFIED[2]].observed == pytest.approx(sizes.max(), rel=1e-9)
    event_s = rows["t_ns"][rows["event"] >= 0] * 1e-9
    assert claims[CERTIFIED[3]].observed == pytest.approx(np.diff(event_s).min(), rel=1e-6)


# --- violated -------------------------------------------------------------------------------------


def test_a_run_of_another_plant_is_none_of_the_certificates_document(make: Make) -> None:
    """The certificate is for a plant equal to the model that starts at a tenth of the distance."""
    run = simulate(make())
    plant = {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "initial_state": [0.1, 0.0]}
    other = changed(run, scenario=make(plant=plant))
    judged = RunClaims(other).evaluate()
    claims = {claim.what: claim for claim in judged if claim.source == "certificate"}
    assert {(claim.verdict, claim.since_s) for claim in claims.values()} == {(ENDED, 0.0)}
    # it makes no assumption on the plant
    assert [claim.verdict for claim in judged if claim.source == "(I1)"] == [HELD, HELD]


@pytest.mark.parametrize(
    ("table", "column", "by", "claimed", "verdict"),
    [
        (PLANT_STEP, "x", 100.0, "the state is bounded", ENDED),
        (SENSOR_MEASUREMENT, "e_s_norm", 5.0, CERTIFIED[0], VIOLATED),
        (CONTROLLER_STEP, "x_c", 1e-3, "x_c − x_s is the sum of the missed jumps", VIOLATED),
    ],
)
def test_a_wrong_value_ends_or_violates_its_claim_from_its_time_on(
    run: RunRecord, table: str, column: str, by: float, claimed: str, verdict: ClaimVerdict
) -> None:
    """A state that does not follow from the one before is no run of the document; ‖e_s‖ is recorded, too."""
    rows = run[table].copy()
    row = np.flatnonzero(rows["event"] < 0)[150] if table == SENSOR_MEASUREMENT else 200
    rows[column][row] += by
    claims = {claim.what: claim for claim in RunClaims(changed(run, {table: rows})).evaluate()}
    assert claims[claimed].verdict is verdict
    assert claims[claimed].since_s == pytest.approx(rows["t_ns"][row] * 1e-9, abs=0.011)
    assert (claims["the state is bounded"].verdict is HELD) == (table == SENSOR_MEASUREMENT)


BETWEEN = {
    "name": "between", "horizon_s": 2.0,
    "model": {"A": [[0.0, 1.5], [-0.1, -0.2]], "B": [[0.0], [1.0]], "gain": [[-0.2, -0.4]]},
    "plant": {"initial_state": [1.0, 3.0], "rate_hz": 50.0, "measure_every": 50},
    "trigger": {"policy": "periodic", "period_s": 1.0},
    "network": {"mansd": 0, "loss": {"model": "lossless"}},
    "controller": {"rate_hz": 50.0},
}  # fmt: skip
"""A scenario with three measurements: x is largest between two of them."""


def test_claims_about_x_are_compared_at_every_step_of_the_plant() -> None:
    claim = "the state is bounded"
    record = simulate(resolve(validate(BETWEEN, "between")))
    steps = record[PLANT_STEP].copy()
    assert len(steps) == 101
    assert len(record[SENSOR_MEASUREMENT]) == 3
    assert certified(record)[claim].verdict is HELD
    steps["x"][63] *= 1000.0
    wrong = certified(changed(record, {PLANT_STEP: steps}))[claim]
    assert (wrong.verdict, wrong.since_s) == (ENDED, pytest.approx(1.24))  # the motion from there on


def test_a_claim_that_ends_is_compared_up_to_its_end(run: RunRecord) -> None:
    rows = run[SENSOR_MEASUREMENT].copy()
    rows["e_s_norm"][[100, 400]] = 5.0
    late = np.delete(rows, slice(300, 310))
    earlier = np.delete(late, 100)  # that event is missing, too
    rows["e_s_norm"][100] = 0.0
    for damaged, verdict, since_s in (
        (late, VIOLATED, 1.0),
        (earlier, ENDED, 0.99),
        (np.delete(rows, slice(300, 310)), ENDED, 2.99),
    ):
        claim = certified(changed(run, {SENSOR_MEASUREMENT: damaged}))[CERTIFIED[0]]
        assert (claim.verdict, claim.since_s) == (verdict, pytest.approx(since_s))
        assert claim.ratio is not None
        assert (claim.ratio < 1) == (verdict is ENDED)


@pytest.mark.parametrize("process", ["plant", "controller"])
def test_certified_claims_need_the_rows_of_every_process(run: RunRecord, process: str) -> None:
    """Claims on recorded signals are checked; too little is known to compare the run with a document."""
    assert RunClaims(without(run, "sensor")).evaluate() == []
    for claim in certified(without(run, process)).values():
        assert (claim.verdict, claim.since_s) in {(ENDED, 0.0), (ClaimVerdict.UNCHECKED, 0.0)}


# --- no certificate is violated; random scenarios are checked in tests/fuzz -----------------------


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("double_integrator", ['trigger={policy="relative", sigma=0.05}', "network.mansd=0"]),
        ("double_integrator", ["plant.measurement.noise_bound=[0.01, 0.01]",
                               'network.initial_sync="known_state"']),
        ("double_integrator", ["plant.initial_state=[3.0, 1e-9]"]),
        ("double_integrator", ["trigger.floor=0.0", "horizon_s=150", "plant.rate_hz=200",
                               "controller.rate_hz=200"]),
        ("double_integrator", ['trigger={policy="periodic", period_s=0.1}', "network.mansd=0"]),
        ("double_integrator", ['trigger={policy="mixed", sigma=0.05, epsilon=0.01}']),
        ("unstable_pendulum", []),
    ],
)  # fmt: skip
def test_no_claim_is_violated_at_a_set_point(name: str, settings: list[str]) -> None:
    """Triggers compare with x − x_r; rounding is that of x; u is 0 and not u_r at first."""
    x_r = 3.0 if name == "double_integrator" else 0.1
    settings = [f"controller.setpoint=[{x_r}, 0.0]", *settings]
    checked = RunClaims(simulate(resolved(name, *settings)))
    claims = checked.evaluate()
    verdicts = {claim.verdict for claim in claims}
    assert VIOLATED not in verdicts
    assert HELD in verdicts
    assert not checked.evidence.certificates  # they are about the deviations
    if any(policy in setting for setting in settings for policy in ("periodic", "relative", "mixed")):
        certified = [claim.verdict for claim in claims if claim.source == "certificate"]
        assert set(certified) == {HELD}


SMALL = {
    "name": "small", "horizon_s": 2.0,
    "model": {"A": [[0.0, 1.0], [2.0, -0.5]], "B": [[0.0], [1.0]], "gain": [[-6.0, -3.0]]},
    "network": {"mansd": 1, "loss": {"model": "bernoulli", "probability": 0.5}},
    "controller": {"rate_hz": 50.0},
}  # fmt: skip


@pytest.mark.parametrize("number", [2839, 4099, 12380])
def test_no_claim_is_violated_in_runs_that_an_attack_found(number: int) -> None:
    """u_r ≠ 0 before the first input; an event at the time of a change."""
    record = simulate(resolve(validate(random_scenario(number), "random")))
    assert VIOLATED not in {claim.verdict for claim in RunClaims(record).evaluate()}


@pytest.mark.parametrize(
    "trigger",
    [
        {"policy": "relative", "sigma": 0.01},
        {"policy": "periodic", "period_s": 0.1},
        {"beta": 1e-200, "alpha_per_s": 1.0},
    ],
)
@pytest.mark.parametrize("size", [1e-320, 1e-300, 1e-170, 1e-151])
def test_the_rounding_of_the_smallest_numbers_violates_no_claim(trigger: dict[str, Any], size: float) -> None:
    """They have fewer digits, and their squares are 0: bounds from x(0) were 1e-8 of what they had to be."""
    plant = {"initial_state": [size, 0.0], "rate_hz": 50.0}
    claims = RunClaims(simulate(resolve(validate(SMALL | {"plant": plant, "trigger": trigger}, "small"))))
    judged = claims.evaluate()
    assert {claim.verdict for claim in judged if claim.source == "(I1)"} == {HELD}
    assert VIOLATED not in {claim.verdict for claim in judged}


def test_a_state_that_decays_to_the_smallest_numbers_violates_no_claim() -> None:
    trigger = {"policy": "relative", "sigma": 0.01}
    plant = {"initial_state": [1.0, 0.0], "rate_hz": 50.0}
    content = SMALL | {"plant": plant, "trigger": trigger, "horizon_s": 430.0}
    record = simulate(resolve(validate(content, "small")))
    assert 0 <= np.linalg.norm(record[PLANT_STEP]["x"][-1]) < 1e-315
    assert {claim.verdict for claim in RunClaims(record).evaluate()} == {HELD}


# --- claims that cannot be judged -----------------------------------------------------------------


def test_too_many_dropouts_end_the_papers_theorems(make: Make) -> None:
    """The theorems assume M − 1; consequences of (I1) alone do not and are judged to the end."""
    network = {"loss": {"model": "worst_case"}, "enforce_mansd": False, "mansd": 2}
    record = simulate(make(network=network, certificate={"paper": True}))
    claims = RunClaims(record).evaluate()
    since = [claim.since_s for claim in claims if claim.verdict is ENDED]
    theorems = [claim for claim in claims if claim.source.startswith("Theorem")]
    assert theorems
    assert {claim.verdict for claim in theorems} == {ENDED}
    # t_0 arrives; of the following updates, the third loss is one too many.
    assert since == pytest.approx([event_s(record, 3)] * len(since))
    assert {claim.verdict for claim in claims if claim.source == "(I1)"} == {HELD}


def test_a_claim_is_not_held_where_the_record_has_no_rows(run: RunRecord) -> None:
    """Measurements continue after the controller's record ends: ‖e_c‖ is unknown from 2 s on."""
    ticks, deliveries = run[CONTROLLER_STEP], run[CONTROLLER_DELIVERY]
    early = {
        CONTROLLER_STEP: ticks[ticks["t_ns"] < 2_000_000_000],
        CONTROLLER_DELIVERY: deliveries[deliveries["now_ns"] < 2_000_000_000],
    }
    shortened = changed(run, early)
    unknown = [c for c in RunClaims(shortened).evaluate() if "e_c" in c.bound or c.source == "(I1)"]
    assert unknown
    for claim in unknown:
        assert claim.verdict is not HELD
        assert claim.since_s is not None
        assert claim.since_s <= 2.02


def test_nothing_is_claimed_of_the_controllers_error_before_its_first_input_acts() -> None:
    """All updates until 0.35 s are late, and five actuations lost: then 34 updates are missing for 40 ms.

    They act together, so their delays are a part of the start. ‖e_c‖ was larger than its bound until then.
    """
    plant = {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]]}
    lost = {"mansd": 5, "loss": {"model": "scripted", "lost": [30, 31, 32, 33, 34]}}
    content = {
        "name": "late_start", "horizon_s": 2.0, "model": plant | {"gain": [[-1.0, -1.4]]},
        "plant": plant | {"draw": "given", "initial_state": [1.0, 0.0], "rate_hz": 100.0},
        "controller": {"rate_hz": 100.0, "predictions": 7},
        "trigger": {"beta": 0.002, "alpha_per_s": 0.25},
        "network": {"mansd": 0, "loss": {"model": "lossless"}, "actuation": lost},
        "certificate": {"late_periods": 0},
    }  # fmt: skip

    def network(data: bytes, now_ns: int) -> int:
        header = read_header(data)
        assert header is not None
        return max((348 if header.sequence else 300) * MS - now_ns, 0)

    record = simulate(resolve(validate(content, "here")), network)
    claims = RunClaims(record)
    assert claims.certified_for is not None
    assert claims.certified_for.start_s == pytest.approx(0.36)
    assert claims.certified_for.delay_s == pytest.approx(0.06)
    assert {claim.verdict for claim in certified(record).values()} == {HELD}
    (certificate,) = claims.certified_evidence.certificates
    (part,) = aligned_parts(record)
    t_s, errors = np.array(part.aligned.t_ns * 1e-9, dtype=np.float64), part.aligned.e_c_norm
    exceeds = errors > certificate.certificate.controller_error(t_s)
    assert t_s[exceeds].max() == pytest.approx(0.34)


# --- changes of settings --------------------------------------------------------------------------


CONTENT: dict[str, Any] = CHANGING | {
    "horizon_s": 6.0,
    "plant": CHANGING["plant"] | {"uncertainty_A": [[0.0, 0.0], [0.0, 0.1]]},
    "trigger": {"beta": 0.05, "alpha_per_s": 0.2},
    "network": {"mansd": 1, "loss": {"model": "bernoulli", "probability": 0.3}},
}
STOP_NS = 3_003 * MS
APART_NS = 47 * MS


def run_with(*changes: tuple[float, dict[str, Any]], **more: Any) -> RunRecord:
    changes_table = [{"at_s": at_s, "set": settings} for at_s, settings in changes]
    return simulate(resolve(validate(CONTENT | {"changes": changes_table} | more, "here")))


def test_a_change_of_the_loss_alone_affects_no_claim() -> None:
    claims = RunClaims(run_with((2.0, {"network.loss.probability": 0.9}))).evaluate()
    assert {claim.until_s for claim in claims} == {None}
    assert {claim.verdict for claim in claims} == {ClaimVerdict.HELD}


@pytest.mark.parametrize(
    "settings",
    [
        {"trigger.beta": 0.04, "network.mansd": 2},
        {"controller.setpoint": [3.0, 0.0]},
        {"trigger.beta": 1e-6},
    ],
)
def test_certificates_speak_of_the_run_until_the_first_change_and_the_identity_of_all_of_it(
    settings: dict[str, Any],
) -> None:
    """Until then the claims are those of a run that ends there."""
    record = run_with((2.005, settings), (4.0, {"controller.setpoint": [1.0, 0.0]}))
    claims = {(claim.source, claim.what): claim for claim in RunClaims(record).evaluate()}
    assert {claim.verdict for claim in claims.values()} == {HELD}
    of_guarantee = 2.005 if "network.mansd" in settings else None
    until_s = {ClaimKind.IDENTITY: None, ClaimKind.GUARANTEE: of_guarantee}
    for claim in claims.values():
        assert claim.until_s == until_s.get(claim.kind, 2.005)
    shorter = {(claim.source, claim.what): claim for claim in RunClaims(run_with(horizon_s=2.005)).evaluate()}
    for key, claim in claims.items():
        if claim.until_s is not None and not key[0].startswith("Theorem 1"):
            assert claim.ratio == pytest.approx(shorter[key].ratio)
            assert claim.certified == shorter[key].certified


def test_where_a_run_does_not_conform_counts_until_the_change() -> None:
    """The plant applies an old input from 3 s, or from 1 s, to 0.3 s later."""
    record = run_with((2.005, {"trigger.beta": 0.04}))

    def with_old_input(from_s: float) -> RunClaims:
        steps = record[PLANT_STEP].copy()
        old = (steps["t_ns"] >= from_s * 1e9) & (steps["t_ns"] < (from_s + 0.3) * 1e9)
        steps["actuation"][old] = steps["actuation"][old][0]
        return RunClaims(changed(record, {PLANT_STEP: steps}))

    late, early = with_old_input(3.0), with_old_input(1.0)
    assert {claim.verdict for claim in late.evaluate() if claim.is_certified} == {HELD}
    ended = [claim for claim in early.evaluate() if claim.verdict is ENDED]
    assert {claim.cause for claim in ended if claim.is_certified} == {ClaimCause.CONFORMANCE}
    assert {claim.verdict for claim in early.evaluate() if claim.source == "(I1)"} == {HELD}


def test_an_input_outside_the_range_of_the_gain_refutes_nothing() -> None:
    """Only the set-point's u_r uses the second input."""
    content = {
        "name": "redundant", "horizon_s": 2.0,
        "model": {"A": [[0.5, 0.0], [0.0, -1.0]], "B": [[1e-3, 0.0], [0.0, 1.0]],
                  "gain": [[-1500.0, 0.0], [0.0, 0.0]]},
        "plant": {"initial_state": [1e-4, 0.0], "rate_hz": 500.0},
        "controller": {"rate_hz": 100.0, "setpoint": [0.0, 1.0]},
        "trigger": {"beta": 1e-3, "alpha_per_s": 0.3},
        "network": {"mansd": 0, "loss": {"model": "bernoulli", "probability": 0.0}},
    }  # fmt: skip
    claims = RunClaims(simulate(resolve(validate(content, "redundant")))).evaluate()
    assert VIOLATED not in {claim.verdict for claim in claims}


# --- stopped runs --------------------------------------------------------------------------------


def stopped(record: RunRecord, reached_ns: dict[str, int]) -> RunRecord:
    """The record of the same run with its processes stopped at these times."""
    rows = {
        table: record[table][record[table]["now_ns"] <= reached_ns[OWNER[table]]] for table in record.tables
    }
    reports = {
        role: record.reports[role]
        | {
            "ended": "stopped by the user (SIGINT)",
            "reached_ns": reached_ns[role],
            "rows": {table: len(rows[table]) for table in record.reports[role]["rows"]},
        }
        for role in LOOP_ROLES
    }
    return changed(record, rows, reports=reports, kind="live")


@pytest.mark.parametrize("order", [*permutations(LOOP_ROLES)][::5], ids="-".join)
def test_processes_that_stop_at_different_times_end_no_claim(run: RunRecord, order: tuple[str, ...]) -> None:
    stopped_record = stopped(run, {role: STOP_NS + i * APART_NS for i, role in enumerate(order)})
    claims = RunClaims(stopped_record)
    verdicts = [(claim.source, claim.verdict) for claim in claims.evaluate()]
    assert len(verdicts) > 5
    assert {verdict for _, verdict in verdicts} == {ClaimVerdict.HELD}, verdicts
    assert claims.judged_until_s is not None
    assert 3.0 <= claims.judged_until_s <= STOP_NS * 1e-9
