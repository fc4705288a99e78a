import subprocess
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

from benchmarks import demo_run, latency, lateness, machines, plants, startup
from benchmarks._report import Benchmark, MeasurementError
from benchmarks._runs import Line, execute, first_step_s
from benchmarks._ticks import LOOPS, Ticks
from benchmarks.latency import Sample
from benchmarks.lateness import Kernel
from cosim.live.progress import account_line

NAMES = (
    "demo_run", "flood", "latency", "lateness", "startup", "recovery", "machines", "plants",
    "simulation", "batch", "campaign", "relays", "relay_delay", "relay_flows", "relay_soak",
)  # fmt: skip
ACCOUNT = {
    "t_s": 0.0, "events": 1, "deliveries": 1, "longest_loss_burst": 0, "x_norm": 1.0, "live": None,
}  # fmt: skip
KERNEL = Kernel(12.0, 20.0, 60.0)
ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("name", NAMES)
def test_each_benchmark_is_declared_under_its_files_name(name: str) -> None:
    declared = import_module(f"benchmarks.{name}").BENCHMARK
    assert isinstance(declared, Benchmark)
    assert declared.name == name


@pytest.mark.parametrize("arguments", [["-m", "benchmarks"], ["benchmarks/machines.py"]])
def test_the_benchmarks_run_as_a_module_and_as_files(arguments: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, *arguments, "--help"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert "--json FILE" in done.stdout


def summary(**changes: Any) -> dict[str, Any]:
    late = {"p50": 16.0, "p99": 40.0, "max": 150.0, "steps": 10_000, "late_steps": 10}
    return {"missing_samples": 0, "unintended_losses": 0, "lateness_us": {"plant": late}} | changes


def test_a_complete_and_punctual_demo_reaches_all_goals() -> None:
    verdicts = [row.holds for row in demo_run.rows_of(summary()) if row.goal is not None]
    assert verdicts == [True, True, True]


def test_a_missing_sample_or_too_many_late_steps_miss_their_goals() -> None:
    late = summary()["lateness_us"]["plant"] | {"late_steps": 11}
    rows = demo_run.rows_of(summary(missing_samples=1, lateness_us={"plant": late}))
    assert [row.holds for row in rows[:3]] == [False, True, False]


def test_latency_compares_the_medians_over_rounds() -> None:
    ours = [Sample(30.0, 100.0, 10), Sample(36.0, 500.0, 10), Sample(90.0, 120.0, 10)]
    pings = [Sample(12.0, 50.0, 20)] * 3
    p50, p99 = latency.rows_of("settings", ours, pings, ["sched_fifo"])
    assert (p50.value, p50.ratio, p50.holds) == (36.0, 3.0, True)
    assert (p99.value, p99.ratio, p99.holds) == (120.0, 2.4, None)
    assert p50.note == "30 updates, 60 pings; not granted: sched_fifo"


def test_quantiles_of_a_histogram_are_the_middle_of_the_bin_they_fall_in() -> None:
    histogram = {12: 98, 20: 1, 400: 1}
    assert lateness.quantile_of(histogram, 0.5) == 12.5
    assert lateness.quantile_of(histogram, 0.99) == 20.5
    assert lateness.quantile_of(histogram, 1.0) == 400.5


def test_an_empty_histogram_is_an_error() -> None:
    with pytest.raises(ValueError, match="no quantiles"):
        lateness.quantile_of({}, 0.5)


def rounds(fifo: str) -> dict[tuple[str, bool], list[Ticks]]:
    ticks = Ticks(15.0, 24.0, 90.0, {"sched_fifo": fifo})
    return {(kind, asked): [ticks] * 3 for kind in LOOPS for asked in (True, False)}


def test_lateness_is_judged_against_cyclictest() -> None:
    rows = lateness.rows_of(rounds("granted"), [KERNEL] * 3, None)
    (judged,) = [row for row in rows if row.goal is not None]
    assert judged.peer is not None
    assert judged.peer.name == "cyclictest"
    assert judged.ratio == 1.2
    assert judged.holds is True


@pytest.mark.parametrize(
    ("fifo", "kernel", "missing", "why"),
    [
        ("refused: Operation not permitted", [KERNEL], None, "Operation not permitted"),
        ("granted", [], "cyclictest is not installed", "not installed"),
    ],
)
def test_lateness_is_not_judged_without_sched_fifo_or_cyclictest(
    fifo: str, kernel: list[Kernel], missing: str | None, why: str
) -> None:
    rows = lateness.rows_of(rounds(fifo), kernel, missing)
    (judged,) = [row for row in rows if row.goal is not None]
    assert judged.holds is None
    assert why in judged.as_json()["note"]


def test_the_first_step_is_bounded_by_the_promptest_progress_line() -> None:
    lines = [
        Line(100.9, "noack: something else"),
        Line(102.0, account_line(ACCOUNT | {"t_s": 0.25}, 20.0)),
        Line(102.2, account_line(ACCOUNT | {"t_s": 0.5}, 20.0)),  # an epoch at 101.75 or before
        Line(103.0, account_line(ACCOUNT | {"t_s": 1.0}, 20.0)),
    ]
    assert first_step_s(100.0, lines) == pytest.approx(1.75)


def test_without_a_progress_line_there_is_no_first_step() -> None:
    assert first_step_s(100.0, [Line(101.0, "noack: no run")]) is None


def test_startup_has_a_row_for_the_goal_and_one_for_the_peer() -> None:
    goal, peer, launch = startup.rows_of([1.0, 1.2, 5.0], [0.9], [0.2, 0.3, 0.4])
    assert (goal.value, goal.holds) == (1.2, True)
    assert peer.ratio == pytest.approx(4.0)
    assert launch.value == 0.9
    assert len(startup.rows_of([1.0], [], [0.2])) == 2


def test_a_program_that_fails_is_reported_with_its_last_words() -> None:
    with pytest.raises(MeasurementError, match=r"ended with 3, said 'sorry'"):
        execute([sys.executable, "-c", "import sys; print('sorry', file=sys.stderr); sys.exit(3)"])


def test_a_programs_output_and_lines_are_kept_apart() -> None:
    finished = execute([sys.executable, "-c", "import sys; print(1); print(2, file=sys.stderr)"])
    assert finished.stdout == "1\n"
    assert [line.text for line in finished.lines] == ["2"]


def test_the_pickled_alternative_gives_messages_back_and_refuses_a_wrong_tag() -> None:
    inputs = machines.Inputs()
    message = inputs.measurements[7]
    datagram = machines.pickled(inputs.key, message)
    found = machines.unpickled(inputs.key, datagram)
    assert found[:3] == message[:3]
    assert found.vector.tolist() == message.vector.tolist()
    with pytest.raises(ValueError, match="wrong tag"):
        machines.unpickled(bytes(32), datagram)


def test_each_case_gives_a_row_with_its_alternative() -> None:
    inputs = machines.Inputs()
    cases = [
        *machines.machine_cases(inputs),
        *machines.wire_cases(inputs),
        machines.telemetry_case(inputs),
    ]
    for case in cases:
        row = machines.compare(case, rounds=1)
        assert row.peer is not None
        assert row.ratio is not None
        assert row.goal is None


def test_a_plants_step_is_held_against_its_period_and_a_linear_plants() -> None:
    for case in plants.CASES:
        ours, linear = plants.timed(case, count=20, pace_ns=0, asked=False)
        assert len(ours.us) == len(linear.us) == 19
        p50, p99, share = plants.rows_of(case, ours, linear)
        assert p50.peer is not None
        assert p50.value is not None
        assert p99.value is not None
        assert p50.value <= p99.value
        assert share.value == pytest.approx(p99.value / 20)  # per cent of 2 ms of wall time


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="not a git repository")
def test_the_repositorys_files_are_copied_without_what_was_made_from_them(tmp_path: Path) -> None:
    startup.copy_repository(tmp_path)
    assert (tmp_path / "Makefile").is_file()
    assert (tmp_path / "noack" / "protocol" / "wire_format.py").is_file()
    assert not (tmp_path / ".git").exists()
    assert not list(tmp_path.rglob("*.pyc"))
