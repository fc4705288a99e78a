"""The difference to the ideal loop is explained if the record is the scenario's; the commands."""

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import cosim.analysis.fidelity
import noack
from cosim.analysis.fidelity import (
    Fidelity,
    IncomparableError,
    compute_fidelity,
    fidelity_for_summary,
    recorded_loop,
)
from cosim.analysis.summary.summary_model import NoFidelityPart
from cosim.live.finalize import finalize
from cosim.record.run_record import RecordedRun, RunRecord, load_run
from cosim.simulation.virtual_time import UserNetwork, simulate, simulate_run
from noack.protocol.record_tables import CONTROLLER_DELIVERY, CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.record.changed_records import changed
from tests.helpers.command_line import invoke

LANE = Path(__file__).parents[3] / "scenarios" / "lane_following.toml"


def lane(network: UserNetwork | None = None, *settings: str) -> RunRecord:
    scenario = load(LANE, ["horizon_s=4", "plant.rate_hz=100", "controller.rate_hz=100", *settings])
    return simulate(resolve(scenario), network)


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return lane()


@pytest.fixture(scope="module")
def fidelity(record: RunRecord) -> Fidelity:
    return compute_fidelity(record)


def test_the_difference_to_the_ideal_loop_is_explained(fidelity: Fidelity) -> None:
    # The residual is rounding, about 1e-15 of x; the difference is a few per cent of x.
    assert fidelity.explained_relative < 1e-9
    assert fidelity.explained
    assert 1e-4 < fidelity.total.rms / fidelity.rms_live < 0.5
    assert sum(stage.share for stage in fidelity.stages) == pytest.approx(1.0, rel=1e-9)
    assert fidelity.stages[2].events == fidelity.stages[3].events == fidelity.events_live
    assert fidelity.stages[3].max_event_difference_s == pytest.approx(0.0, abs=1e-9)
    assert fidelity.stages[3].first_different_event is None
    for difference in (fidelity.total, *(stage.difference for stage in fidelity.stages)):
        assert math.hypot(*difference.rms_by_state) == pytest.approx(difference.rms)
        assert max(difference.max_by_state) <= difference.max * (1 + 1e-12)
        assert difference.rms <= difference.max
    assert fidelity.samples == 401
    assert fidelity.compared_s == 4.0


def test_delay_is_attributed_to_delay() -> None:
    prompt, late = (compute_fidelity(lane(lambda data, now_ns, d=d: d)) for d in (0, 30_000_000))  # type: ignore[misc]
    sampling, delay = (late.stages[i].difference.rms for i in (0, 1))
    assert delay > 2 * prompt.stages[1].difference.rms
    # the same fates without delay
    assert sampling == pytest.approx(prompt.stages[0].difference.rms)


def test_a_start_without_actuation_is_attributed_to_held_actuation() -> None:
    """Known x(0), no event: the plant still waits 8 ms for the first tick."""
    settings = ("trigger.beta=100", 'network.initial_sync="known_state"', "controller.phase=0.8")
    fidelity = compute_fidelity(lane(None, *settings))
    sampling, delay, held, _ = fidelity.stages
    at_rest = compute_fidelity(lane(None, "plant.initial_state=[0.0, 0.0, 0.0, 0.0]"))
    assert (at_rest.explained, at_rest.explained_relative) == (True, 0.0)
    assert "rounding" in at_rest.verdict
    assert fidelity.events_live == 0
    assert sampling.difference.max == pytest.approx(0.0, abs=1e-12)
    assert delay.difference.max == 0.0
    assert held.share == pytest.approx(1.0)
    assert held.max_event_difference_s is None


def test_a_loop_that_amplifies_rounding_or_accumulates_events_is_not_compared() -> None:
    """This rule does not tolerate the losses; a deviation grows between equal events."""
    policy = '{ policy = "dynamic", sigma = 0.2, theta_s = 0.1, decay_per_s = 0.5 }'
    with pytest.raises(IncomparableError, match="turns rounding into another run"):
        compute_fidelity(lane(None, f"trigger={policy}", 'mode="zoh"', "horizon_s=100"))
    unstable = lane(None, "model.parameters.gain=-1.0", "model.allow_unstable=true", "horizon_s=20")
    with pytest.raises(IncomparableError, match=r"events accumulate \(more than 200.* `noack compare`"):
        compute_fidelity(unstable, max_events=200)


@pytest.mark.parametrize(("residual", "explained"), [(0.1, True), (0.11, False)])
def test_a_residual_of_a_tenth_is_explained_and_no_more(
    fidelity: Fidelity, residual: float, explained: bool
) -> None:
    other = replace(fidelity, explained_relative=residual)
    assert (other.explained, "too large" not in other.verdict) == (explained, explained)


def test_a_plant_that_missed_its_input_once_is_not_explained(record: RunRecord) -> None:
    steps = record[PLANT_STEP].copy()
    steps["x"][200:] += 0.1
    assert not compute_fidelity(changed(record, {PLANT_STEP: steps})).explained


@pytest.mark.parametrize(
    ("table", "column", "row", "value", "reason"),
    [
        (PLANT_STEP, "x", slice(300, None), math.nan, "diverged"),
        (SENSOR_MEASUREMENT, "t_ns", None, 2**62, "has times that no run has"),
        (SENSOR_MEASUREMENT, "t_ns", None, -(2**63), "has times that no run has"),
        (CONTROLLER_STEP, "model_t_ns", None, 2**63 - 1, "has times that no run has"),
        (CONTROLLER_DELIVERY, "model_t_ns", None, -1, "has times that no run has"),
        (PLANT_STEP, None, np.s_[50:51], None, "steps of the plant"),
        (PLANT_STEP, None, np.s_[300:], None, "steps of the plant"),
        (SENSOR_MEASUREMENT, None, np.s_[5:], None, "5 measurements"),
        (SENSOR_MEASUREMENT, None, np.s_[50:51], None, "sensor's record"),
        (CONTROLLER_STEP, None, np.s_[300:], None, "controller's record"),
        (CONTROLLER_STEP, None, np.s_[50:51], None, "controller's record"),
        (CONTROLLER_DELIVERY, None, np.s_[:1], None, "controller's record"),
    ],
)
def test_a_record_that_is_not_that_of_a_whole_run_is_not_compared(
    record: RunRecord, table: str, column: str | None, row: Any, value: Any, reason: str
) -> None:
    """Without a column, rows are missing; without a row, the one in the middle is meant."""
    rows = record[table].copy()
    if column is None:
        rows = np.delete(rows, row)
    else:
        rows[column][len(rows) // 2 if row is None else row] = value
    broken = changed(record, {table: rows})
    with pytest.raises(IncomparableError, match=reason):
        compute_fidelity(broken)
    summary = fidelity_for_summary(broken)
    assert isinstance(summary, NoFidelityPart)
    assert reason in summary.reason


def test_an_interrupted_run_is_compared_up_to_its_end(record: RunRecord) -> None:
    """The sensor was the first to end."""
    short = changed(record, {SENSOR_MEASUREMENT: record[SENSOR_MEASUREMENT][:250]})
    fidelity = compute_fidelity(short)
    assert fidelity.samples == 250
    assert fidelity.explained_relative < 1e-9


def test_an_event_at_the_last_measurement_is_one_of_the_ideal_loop() -> None:
    """An update every 0.1 s: the run had 41, and the ideal loop was said to have 40."""
    fidelity = compute_fidelity(lane(None, 'trigger={policy="periodic", period_s=0.1}'))
    assert fidelity.events_live == fidelity.events_ideal == 41
    assert fidelity.first_different_event is None


def test_events_beyond_the_run_have_the_fates_of_their_own_loop(tmp_path: Path) -> None:
    """They had those of the first loop, whose random numbers are others."""

    def run(horizon_s: float) -> RecordedRun:
        scenario = noack.load("different_loops", {"horizon_s": horizon_s})
        return load_run(noack.simulate(scenario, runs=tmp_path).directory)

    for short, whole in zip(run(2.0).loops, run(6.0).loops, strict=True):
        sent = whole.events()["event"]
        accepted = np.isin(sent, whole.columns(CONTROLLER_DELIVERY, "sequence")["sequence"])
        assert len(short.events()) < len(sent)
        assert [*map(recorded_loop(short).schedule.delivered, sent.tolist())] == accepted.tolist()


def test_the_summary_has_the_comparison_or_the_reason(
    record: RunRecord, fidelity: Fidelity, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = fidelity_for_summary(record)
    assert good == fidelity.summary()
    json.dumps(good.model_dump(), allow_nan=False)

    def broken(*_: object) -> Fidelity:
        raise RuntimeError("a bug")

    monkeypatch.setattr(cosim.analysis.fidelity, "compute_fidelity", broken)
    bad = fidelity_for_summary(record)
    assert bad == NoFidelityPart(reason="RuntimeError('a bug')")
    monkeypatch.setattr(cosim.analysis.fidelity, "_STEPS_AT_THE_END", 100)
    assert "noack fidelity" in str(fidelity_for_summary(record).reason)
    steps = record.count(PLANT_STEP)
    monkeypatch.setattr(cosim.analysis.fidelity, "_STEPS_AT_THE_END", 10 * steps)
    assert fidelity_for_summary(record, loops=10) == bad
    assert "noack fidelity" in str(fidelity_for_summary(record, loops=11).reason)


# --- noack replay --------------------------------------------------------------


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    scenario = load(LANE, ["horizon_s=1", "plant.rate_hz=50", "controller.rate_hz=50"])
    finalize(simulate_run(scenario, folder), report=False, view=False)
    return folder


@pytest.fixture
def runs(simulated: Path, tmp_path: Path) -> Path:
    """An own folder of runs."""
    return Path(shutil.copytree(simulated, tmp_path / "runs", symlinks=True))


def rewrite(runs: Path, table: str, change: Callable[[pa.Table], pa.Table]) -> None:
    path = runs / "latest" / "record" / f"{table}.parquet"
    pq.write_table(change(pq.read_table(path)), path)


def alter(runs: Path, table: str, column: str, by: float) -> None:
    """Add a ramp to a column."""

    def changed(rows: pa.Table) -> pa.Table:
        values = rows[column].to_numpy() + np.linspace(0, by, len(rows))
        return rows.set_column(rows.schema.get_field_index(column), column, pa.array(values))

    rewrite(runs, table, changed)


def test_replay_takes_the_last_run(simulated: Path) -> None:
    result = invoke("replay", "--runs", simulated)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "bit-exact: " in result.stdout
    document = json.loads(invoke("replay", "--runs", simulated, "--json").stdout)
    assert (document["bit_exact"], document["complete"]) == (True, True)
    assert document["first_difference"] is None
    assert document["inputs"] == sum(process["inputs"] for process in document["processes"])
    assert document["changed_since"] == []


def test_a_difference_is_reported_and_fails(runs: Path) -> None:
    alter(runs, "controller_step", "x_c_3", 1e-9)
    path = runs / "latest/environment.json"
    environment = json.loads(path.read_text())
    environment["packages"]["numpy"] = "1.0"
    path.write_text(json.dumps(environment))
    result = invoke("replay", "--runs", runs)
    assert result.exit_code == 1
    assert "controller_step row 1, x_c_3" in result.stdout
    assert "0x1." in result.stdout
    assert "numpy was 1.0, is " in result.stdout
    result = invoke("replay", "--runs", runs, "--json")
    document = json.loads(result.stdout)
    assert (result.exit_code, document["first_difference"]["column"]) == (1, "x_c_3")
    assert len(document["changed_since"]) == 1


def test_an_empty_record_fails(runs: Path) -> None:
    for path in (runs / "latest/record").glob("*.parquet"):
        rewrite(runs, path.stem, lambda rows: rows.slice(0, 0))
    result = invoke("replay", "--runs", runs)
    assert result.exit_code == 1
    assert "nothing to compare" in result.stdout
