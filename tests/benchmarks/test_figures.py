import sys
from typing import Any

import pytest

from benchmarks import ends, latency, runs, simulation
from benchmarks.bare_programs import LOOPS
from benchmarks.programs import Line, execute, first_step_s
from benchmarks.report import MeasurementError, Rounds


def summary(**changes: Any) -> dict[str, Any]:
    late = {"p50": 16.0, "p99": 40.0, "max": 150.0, "steps": 10_000, "late_steps": 10}
    loop = {"missing_samples": 0, "unintended_losses": 0, "lateness_us": {"plant": late}}
    return {"loops": [loop | changes]}


def test_a_complete_and_punctual_demo_reaches_all_goals() -> None:
    verdicts = [row.holds for row in runs.demo_rows(summary()) if row.goal is not None]
    assert verdicts == [True, True, True]


def test_a_missing_sample_or_too_many_late_steps_miss_their_goals() -> None:
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


def test_without_a_progress_line_there_is_no_first_step() -> None:
    assert first_step_s(100.0, [Line(101.0, "noack: no run")]) is None


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


def test_a_failed_program_is_reported_with_its_last_output() -> None:
    with pytest.raises(MeasurementError, match=r"ended with 3: sorry"):
        execute([sys.executable, "-c", "import sys; print('sorry', file=sys.stderr); sys.exit(3)"])


def test_standard_output_and_error_lines_are_separate() -> None:
    finished = execute([sys.executable, "-c", "import sys; print(1); print(2, file=sys.stderr)"])
    assert finished.stdout == "1\n"
    assert [line.text for line in finished.lines] == ["2"]


def test_a_plant_step_is_compared_with_its_period_and_a_linear_plant() -> None:
    for name, scenario in simulation.plant_cases():
        found = simulation.timed_steps(scenario, count=20, pace_ns=0, asked=False)
        assert len(found) == 20
        p50, p99, share = simulation.plant_rows(name, scenario, found)
        assert p50.peer is not None
        assert p50.value is not None
        assert p99.value is not None
        assert p50.value <= p99.value
        assert share.value == pytest.approx(p99.value / 20)  # per cent of a period of 2 ms
