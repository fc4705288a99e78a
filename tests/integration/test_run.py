"""A whole run of real processes: its files, and what its processes did together.

tests/cosim/simulation/test_whole_loop.py compares what each machine computes with a reference; the
replay of this run shows that its processes computed the same.
"""

import json
from collections import Counter

import numpy as np
import pyarrow.parquet as pq
import pytest
import rerun.chunk

from cosim.analysis.claims.claim_evaluation import ClaimEvaluation
from cosim.analysis.replay import replay
from cosim.output.viewer import blueprint
from cosim.record.align import align_tables
from cosim.record.run_record import RunRecord, load_record
from noack.protocol.record_tables import tables
from tests.cosim.output.viewer.test_viewer import read, series
from tests.cosim.record.changed_records import identity_residual
from tests.integration.conftest import Finished, run_scenario, settings

SUMMARY_KEYS = {
    "scenario", "mode", "mansd", "events", "deliveries", "drops", "forced_deliveries",
    "longest_loss_burst", "assumption_violations", "missing_samples", "unintended_losses",
    "inter_event_min_s", "final_state_norm", "lateness_us", "latency_us", "realtime", "exit",
    "kind", "replay", "fidelity", "claims", "conditions",
}  # fmt: skip

CERTIFIED = "certified for the scenario's plant"
OWN_CLAIMS = {"(I1)", "certificate", "box certificate"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A run on a machine that did not stall: a process that ends misses what others send later."""
    for _ in range(10):
        runs = tmp_path_factory.mktemp("runs")
        found = run_scenario(runs, *settings(speed=5.0, horizon_s=20.0), "--report")
        if (
            found.status
            or max(late["max"] for late in found.summary["loops"][0]["lateness_us"].values()) < 1e5
        ):
            break
    return found


@pytest.fixture(scope="module")
def live(finished: Finished) -> RunRecord:
    return load_record(finished.run_dir)


def test_a_run_completes_with_a_complete_summary(finished: Finished) -> None:
    assert finished.status == 0, finished.stderr
    (loop,) = finished.summary["loops"]
    assert finished.summary.keys() | loop.keys() >= SUMMARY_KEYS
    assert finished.summary["exit"] == {"status": 0, "reason": "horizon"}
    assert finished.loop["missing_samples"] == 0
    assert finished.loop["unintended_losses"] == 0
    violations = finished.loop["assumption_violations"]
    assert "dropouts" not in {one["cause"] for one in violations}  # deadlines may be missed
    assert finished.loop["rejected_datagrams"] == {}
    for role in ("plant", "sensor", "controller", "netem"):
        assert finished.loop["lateness_us"][role].keys() == {
            "p50", "p99", "p999", "max", "steps", "late_steps",
        }  # fmt: skip


def test_the_run_directory_holds_everything(finished: Finished) -> None:
    run_dir = finished.run_dir
    assert json.loads((run_dir / "summary.json").read_text()) == finished.summary
    assert json.loads((run_dir / "environment.json").read_text())["packages"]["numpy"]
    assert (run_dir / "recording.rrd").stat().st_size > 10_000
    assert {log.name for log in (run_dir / "logs").iterdir()} == {
        f"{role}.log" for role in ("plant", "sensor", "controller", "netem", "recorder")
    }
    assert not (run_dir / "spool").exists()
    report = (run_dir / "report.html").read_text(encoding="utf-8")
    assert report.count("<figure") == 8
    assert "completed 20 s" in report
    assert "warning" not in finished.stderr


def test_every_sample_is_recorded(live: RunRecord) -> None:
    scenario = live.scenario
    steps = scenario.timing.horizon_ns // scenario.timing.plant_period_ns + 1
    plant, sensor = live["plant_step"], live["sensor_measurement"]
    assert np.array_equal(plant["t_ns"], np.arange(steps) * scenario.timing.plant_period_ns)
    every = scenario.plant.measure_every
    assert np.array_equal(sensor["t_ns"], plant["t_ns"][::every])
    assert np.array_equal(sensor["x"], plant["x"][::every])
    ticks = (
        scenario.timing.horizon_ns - scenario.timing.controller_phase_ns
    ) // scenario.timing.controller_period_ns
    assert len(live["controller_step"]) == ticks + 1


def test_each_process_receives_from_its_peer_only(live: RunRecord) -> None:
    channel = {role: report["channel"] for role, report in live.reports.items()}
    local = {role: counters["local"] for role, counters in channel.items()}
    picture = {"plant": "sensor", "sensor": "netem", "netem": "controller", "controller": "plant"}
    for role, to in picture.items():
        assert channel[role]["destination"] == local[to]
        assert list(channel[to]["received_from"]) == [local[role]]
    assert local["controller"] not in channel["sensor"]["received_from"]


def test_identity_i1_holds_to_rounding_at_every_sample(live: RunRecord) -> None:
    joined = align_tables(live)
    residual = identity_residual(live)
    in_common = joined.t_ns >= 0
    if live.scenario.network.initial_sync == "first_packet":
        in_common = joined.t_ns >= live["controller_delivery"]["model_t_ns"][0]
    assert np.array_equal(np.isnan(residual), ~in_common)
    # States of a few units and some thousand steps: rounding is far below any physical difference.
    assert residual[in_common].max() < 1e-11


def test_the_run_is_replayed_bit_for_bit(live: RunRecord, finished: Finished) -> None:
    found = replay(live)
    assert found.first_difference is None, str(found.first_difference)
    assert found.gaps == []
    assert found.inputs == sum(len(live[table]) for table in tables(1, 1))
    assert all(leg.compared == leg.received > 0 for leg in found.messages)
    assert finished.loop["replay"] == found.verdict().model_dump()
    assert finished.summary["kind"] == live.kind == "live"


def test_fidelity_explains_the_difference_to_the_ideal_loop(
    finished: Finished,
) -> None:
    fidelity = finished.loop["fidelity"]
    assert fidelity["reason"] is None
    # All effects together explain the run up to rounding: 1e-14 of x, relative to a few per cent.
    assert fidelity["explained_relative"] < 1e-6
    assert 0 < fidelity["rms_x"] < 0.5 * fidelity["rms_x_live"]


def test_the_record_is_plain_parquet(finished: Finished, live: RunRecord) -> None:
    for table in tables(live.loop.n, live.loop.m):
        content = pq.read_table(finished.run_dir / "record" / f"{table}.parquet")
        assert content.num_rows == len(live[table])
        assert content.schema.metadata[b"state_names"] == b'["V", "r", "psi", "Y_g"]'


def test_the_recording_shows_the_record(finished: Finished, live: RunRecord) -> None:
    reader = rerun.chunk.RrdReader(finished.run_dir / "recording.rrd")
    (store,) = reader.recordings()
    rows: Counter[str] = Counter()
    for chunk in reader.stream(store=store):
        batch = chunk.to_record_batch()
        if blueprint.TIMELINE in batch.schema.names:
            rows[chunk.entity_path.removeprefix("/")] += batch.num_rows
    (summary,) = finished.summary["loops"]
    assert rows[blueprint.FORCED] == summary["forced_deliveries"]
    assert rows[blueprint.RECEPTION] == summary["deliveries"] - summary["forced_deliveries"]
    assert rows[blueprint.DROP] == summary["drops"]
    assert rows[blueprint.EVENT] == summary["events"]
    assert rows[blueprint.INPUT] == len(live["controller_step"])
    for name in live.loop.state_names:
        assert rows[blueprint.state_path(name)] == len(live["sensor_measurement"])


def test_no_claim_with_checked_assumptions_is_violated(finished: Finished) -> None:
    """After missed deadlines, claims are void only where no certificate covers them."""
    claims = [c for c in finished.loop["claims"] if c["source"] in OWN_CLAIMS]
    assert {c["source"] for c in claims} >= {"(I1)", "certificate", "box certificate"}
    for claim in claims:
        assert claim["verdict"] in ("held", "void"), claim
        assert (claim["since_s"] is None) == (claim["verdict"] == "held")
        assert claim["verdict"] == "held" or claim["why"]
    conditions = finished.loop["conditions"]
    mansd = finished.summary["mansd"]
    assert 0 < conditions["dropouts"] <= mansd
    assert conditions["delay_s"] >= conditions["sampling_s"] / 2 > 0


def test_the_recording_shows_the_bounds(finished: Finished, live: RunRecord) -> None:
    """The curves drawn during the run equal those that its end evaluates for its schedule."""
    claims = ClaimEvaluation(live)
    claims.wider = None  # the recording has the bounds of the scenario's schedule
    envelopes = claims.envelopes()
    (identity,) = [e.values for e in envelopes if e.label == "bound from (I1)"]
    certified = [
        {e.label: e.values for e in envelopes if e.quantity == "x"}[label]
        for label in (CERTIFIED, "bound, given x at the last event")
    ]
    chunks = read(finished.run_dir / "recording.rrd")
    t_ns, drawn = series(chunks, blueprint.ERROR)
    order = np.argsort(t_ns)
    np.testing.assert_allclose(drawn[order, 0], identity, rtol=1e-9, atol=1e-12)
    _, drawn = series(chunks, blueprint.SIZE_LOG10)
    np.testing.assert_allclose(10 ** drawn[order, :2].T, certified, rtol=1e-9)
