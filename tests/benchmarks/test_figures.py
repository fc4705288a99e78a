"""The figures of single benchmarks, from given measurements, and the programs that they start."""

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import ends, latency, runs, simulation
from benchmarks.bare_programs import LOOPS, Flood, command_of
from benchmarks.faults import FaultedRun, figures_of, recovery_s
from benchmarks.latency import ping
from benchmarks.programs import Line, compiled, execute, first_step_s, provide
from benchmarks.report import MeasurementError, Rounds
from cosim.cli import find_scenario
from cosim.simulation.virtual_time import simulate
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from tests.cosim.record.changed_records import changed, copied


def summary(**changes: Any) -> dict[str, Any]:
    late = {"p50": 16.0, "p99": 40.0, "max": 150.0, "steps": 10_000, "late_steps": 10}
    loop = {"missing_samples": 0, "unintended_losses": 0, "lateness_us": {"plant": late}}
    return {"loops": [loop | changes]}


def test_a_missing_sample_or_too_many_late_steps_miss_their_goals() -> None:
    verdicts = [row.holds for row in runs.demo_rows(summary()) if row.goal is not None]
    assert verdicts == [True, True, True]
    late = summary()["loops"][0]["lateness_us"]["plant"] | {"late_steps": 11}
    rows = [*runs.demo_rows(summary(missing_samples=1, lateness_us={"plant": late}))]
    assert [row.holds for row in rows[:3]] == [False, True, False]


def test_quantiles_of_a_histogram_are_the_middle_of_the_bin_they_fall_in() -> None:
    histogram = {12: 98, 20: 1, 400: 1}
    assert latency.quantile_of(histogram, 0.5) == 12.5
    assert latency.quantile_of(histogram, 0.99) == 20.5
    assert latency.quantile_of(histogram, 1.0) == 400.5


@pytest.mark.parametrize(
    ("ours", "kernel", "holds", "note"),
    [
        (None, {"p50": 12.0, "p99": 20.0, "max": 60.0}, True, ""),
        (None, "cyclictest is not installed", None, "not installed"),
        ("SCHED_FIFO refused", {"p50": 12.0, "p99": 20.0, "max": 60.0}, None, "SCHED_FIFO refused"),
    ],
)
def test_lateness_is_judged_against_cyclictest(
    ours: str | None, kernel: Any, holds: bool | None, note: str
) -> None:
    rounds = {asked: Rounds() for asked in (True, False)}
    for sides in rounds.values():
        for kind in LOOPS:
            sides.add(kind, {"p50": 15.0, "p99": 24.0, "max": 90.0})
    rounds[True].add(latency.KERNEL, kernel)
    if ours is not None:
        rounds[True].add(latency.LOOP, ours)
    (judged,) = [row for row in latency.lateness_rows(rounds) if row.goal is not None]
    assert judged.holds is holds
    assert judged.value == 24.0
    assert note in judged.as_json().get("note", "")


def test_the_end_of_a_long_run_is_judged_by_its_memory_and_its_additional_time() -> None:
    short = ends.End(4.0, 5.0, 200.0, {"claims": 1.0, "replay": 1.0})
    of_runs = {60.0: short, 660.0: ends.End(20.0, 17.0, 500.0, {"claims": 3.0, "replay": 1.2})}
    peak, growth, _, speed, by_cpu, of_replay, claims, _ = ends.rows_of(of_runs)
    assert (peak.value, peak.holds) == (500.0, False)
    assert growth.ratio == 2.5
    assert speed.value == 37.5
    assert (by_cpu.value, by_cpu.holds) == (50.0, False)
    assert of_replay.value == pytest.approx(3000.0)
    assert of_replay.holds
    assert claims.value == 12.0


def test_the_output_of_a_program_is_read_and_a_failed_one_is_reported() -> None:
    assert first_step_s(100.0, [Line(101.0, "noack: no run")]) is None
    finished = execute([sys.executable, "-c", "import sys; print(1); print(2, file=sys.stderr)"])
    assert finished.stdout == "1\n"
    assert [line.text for line in finished.lines] == ["2"]
    with pytest.raises(MeasurementError, match=r"ended with 3: sorry"):
        execute([sys.executable, "-c", "import sys; print('sorry', file=sys.stderr); sys.exit(3)"])


def test_a_plant_step_is_compared_with_its_period_and_a_linear_plant() -> None:
    (name, scenario), *others = simulation.plant_cases()
    assert len(others) > 3
    found = simulation.timed_steps(scenario, count=20, pace_ns=0, asked=False)
    assert len(found) == 20
    p50, p99, share = simulation.plant_rows(name, scenario, found)
    assert p50.peer is not None
    assert p50.value is not None
    assert p99.value is not None
    assert p50.value <= p99.value
    assert share.value == pytest.approx(p99.value / 20)  # per cent of a period of 2 ms


NAME = next(iter(latency.CASES))


@pytest.mark.parametrize(("language", "asked"), [("C", True), ("Python", False)])
def test_every_datagram_of_a_ping_arrives(language: str, asked: bool, tmp_path: Path) -> None:
    if language == "C" and shutil.which("cc") is None:
        pytest.skip("cc is not installed")
    command = command_of("ping") if language == "Python" else [str(compiled("ping.c", tmp_path))]
    found, refused = ping(command, 20, 0.002, asked=asked)
    assert found["count"] == 20
    assert 0 < found["p50"] <= found["p99"]
    known = {"memory_lock", "timer_slack", "sched_fifo", "affinity", "cpu_dma_latency"}
    assert refused <= (known if asked else set())
    with pytest.raises(MeasurementError, match="did not end"):
        ping(["false"], 1, 0.001, asked=False)


def rounds_of(**sides: tuple[float, float]) -> Rounds:
    rounds = Rounds()
    for side, (p50, p99) in sides.items():
        rounds.add(side, {"p50": p50, "p99": p99, "count": 100})
    return rounds


def test_the_ping_in_c_is_the_measure_of_both_quantiles(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without a compiler, the goals are not judged."""
    ours_and_python = {latency.OURS: (28.0, 90.0), latency.PYTHON_PING: (14.0, 45.0)}
    rounds = rounds_of(**ours_and_python, **{latency.C_PING: (20.0, 40.0)})
    p50, p99, *plain = latency.rows_of(NAME, rounds, {"sched_fifo"})
    assert (p50.ratio, p50.holds) == (pytest.approx(1.4), True)
    assert (p99.ratio, p99.holds) == (2.25, False)
    assert [row.ratio for row in plain] == [2.0, 2.0]
    assert all(row.goal is None for row in plain)
    assert "100 updates; 100 and 100 pings; not applied: sched_fifo" in p50.as_json()["note"]
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(MeasurementError) as reason:
        compiled("ping.c", tmp_path)
    rounds = rounds_of(**ours_and_python)
    rounds.add(latency.C_PING, str(reason.value))
    p50, p99, *_ = latency.rows_of(NAME, rounds, set())
    assert p50.holds is p99.holds is None
    assert "cc is not installed" in p50.as_json()["note"]


PERIOD_NS = 2_000_000


def test_the_effects_of_a_flood_are_read_from_the_record() -> None:
    record = simulate(resolve(load(find_scenario("lane_following"), ["horizon_s=4", "ports={}"])))
    flood = command_of("flood", 0.05, 0, 9)
    sent = subprocess.run(flood, capture_output=True, text=True, check=True).stdout
    assert '"sent": ' in sent
    rows = copied(record)
    for table in (PLANT_STEP, CONTROLLER_STEP, SENSOR_MEASUREMENT):
        rows[table]["now_ns"] = rows[table]["t_ns"] + 50_000
    steps, received = rows[PLANT_STEP], rows[SENSOR_MEASUREMENT]
    during = (steps["t_ns"] > 1_000_000_000) & (steps["t_ns"] < 2_000_000_000)
    steps["now_ns"][during] += 7_000_000
    after = (steps["t_ns"] >= 2_000_000_000) & (steps["t_ns"] < 2_040_000_000)
    steps["now_ns"][after] += 3_000_000
    rows[SENSOR_MEASUREMENT] = np.delete(received, [600, 601, 602])
    flooded = changed(record, rows, reports={})
    run = FaultedRun(flooded, {"unintended_losses": 5}, 100.0, Flood(101.0, 102.0, 12_345), None)
    last_late_ns = 2_040_000_000 - PERIOD_NS + 3_050_000
    back_ms = 1e-6 * last_late_ns - 2000.0
    expected = (12_345.0, 3, 5, 50.0, 7050.0, back_ms)
    assert tuple(figures_of(run).values()) == pytest.approx(expected)
    # A late step long after the flood does not count.
    assert recovery_s(np.array([]), 2.0) == 0.0
    assert recovery_s(np.array([1.9, 2.1, 2.3, 3.0]), 2.0) == pytest.approx(0.3)
    assert recovery_s(np.array([1.9, 2.5]), 2.0) == 0.0


@pytest.mark.parametrize(
    ("root", "works", "missing"), [(True, True, []), (True, False, ["b"]), (False, True, ["b"])]
)
def test_a_missing_program_is_installed_or_named(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    root: bool,
    works: bool,
    missing: Sequence[str],
) -> None:
    present, commands = {"a", "apt-get"}, list[list[str]]()

    def execute(command: list[str], **_: Any) -> None:
        commands.append(command)
        if works and command[1] == "install":
            present.add("b")

    monkeypatch.setattr(shutil, "which", lambda name: name if name in present else None)
    monkeypatch.setattr(os, "geteuid", lambda: 0 if root else 1000)
    monkeypatch.setattr(subprocess, "run", execute)
    assert provide({"a": "package-a", "b": "package-b more"}) == missing
    assert [command[-2:] for command in commands[1:]] == [["package-b", "more"]] * root
    assert ("apt-get install package-b more" in capsys.readouterr().err) == bool(missing)


def test_nothing_is_installed_if_all_programs_are_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: pytest.fail("installs"))
    monkeypatch.setattr(shutil, "which", lambda name: name)
    assert provide() == []
