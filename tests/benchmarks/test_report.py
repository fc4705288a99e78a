"""Rows, rounds, the command line and the page of the goals."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.__main__ import BEGIN, END, GOALS, all_benchmarks, rows_of_goals, run, write_docs
from benchmarks.report import Benchmark, Goal, MeasurementError, Peer, Row
from benchmarks.rounds import Rounds, compare, per_cpu_s

HALF = Goal("<=", 0.5)


@pytest.mark.parametrize(
    ("row", "holds"),
    [
        (Row("a", 3.0, "s", goal=Goal("<=", 3)), True),
        (Row("a", 3.01, "s", goal=Goal("<=", 3)), False),
        (Row("a", 3.0, "s", goal=Goal("<", 3)), False),
        (Row("a", 99.9, "%", goal=Goal(">=", 99.9)), True),
        (Row("a", 1, "", goal=Goal("==", 0)), False),
        (Row("a", 30.0, "µs", Peer("ping", 12.0), Goal("<=", 3)), True),  # the ratio is checked
        (Row("nothing asked", 1.0, "s"), None),
        (Row("not measured", None, "s", goal=Goal("<", 3)), None),
        (Row("no peer to compare with", 1.0, "s", Peer("cyclictest", None), Goal("<", 3)), None),
    ],
)
def test_a_row_holds_fails_or_cannot_be_checked(row: Row, holds: bool | None) -> None:
    assert row.holds is holds


def named(name: str, *rows: Row, done: list[str] | None = None) -> Benchmark:
    def measure() -> list[Row]:
        if done is not None:
            done.append(name)
        if not rows and done is None:
            raise MeasurementError("no such program")
        return list(rows)

    return Benchmark(name, name.title(), measure)


def by_name(*benchmarks: Benchmark) -> dict[str, Benchmark]:
    return {benchmark.name: benchmark for benchmark in benchmarks}


def test_rows_and_reasons_are_printed_and_written_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, row = tmp_path / "rows.json", Row("a", 1.5, "s", goal=Goal("<", 3))
    assert run(by_name(named("broken"), named("example", row)), ["--json", str(path)]) == 1
    rows = {row_document["name"]: row_document for row_document in json.loads(path.read_text())}
    assert rows["broken"]["value"] is None
    assert "no such program" in rows["broken"]["note"]
    assert rows["a"] == row.to_json() | {"benchmark": "example"}
    output = capsys.readouterr().out
    assert "Example" in output
    assert "no such program" in output


def rounds_of(ours: list[float], theirs: list[float]) -> Rounds:
    rounds = Rounds()
    for side, values in (("ours", ours), ("theirs", theirs)):
        for value in values:
            rounds.add(side, {"us": value})
    return rounds


def test_a_row_has_the_medians_of_the_rounds_or_the_median_of_their_ratios() -> None:
    row = rounds_of([12.0, 11.0, 900.0], [6.0]).row("cost", "µs", "us", "ours", "theirs", HALF)
    assert (row.value, row.peer, row.ratio, row.holds) == (12.0, Peer("theirs", 6.0), 2.0, False)
    rounds = rounds_of([1.0, 30.0, 3.0], [2.0, 60.0, 8.0])
    row = rounds.row("cost", "µs", "us", "ours", "theirs", HALF, paired=True)
    assert (row.value, row.peer) == (3.0, Peer("theirs", 8.0))
    assert row.ratio == 0.5  # not 3 / 8
    ours, theirs = iter([1.0, 30.0, 3.0]), iter([2.0, 60.0, 8.0])
    again = compare("cost", "µs", lambda: next(ours), ("theirs", lambda: next(theirs)), HALF, rounds=3)
    assert again == row
    assert compare("a", "/s", per_cpu_s(1, lambda: None), Peer("known", 2.0)).ratio is not None


@pytest.mark.parametrize("side", ["ours", "theirs"])
def test_a_side_without_measurements_is_named_and_not_checked(side: str) -> None:
    rounds = rounds_of([1.0, 2.0], [1.0])
    rounds.missing[side] = "lost a datagram"
    row = rounds.row("cost", "µs", "us", "ours", "theirs", HALF, paired=True)
    assert row.holds is None
    assert row.note == f"{side}: lost a datagram"


def test_the_goals_are_selected_in_their_order_and_written_into_the_page(tmp_path: Path) -> None:
    end = Row("1,000 loops: end of the run", 3.0, "s", Peer("the run", 60), Goal("<=", 0.1))
    start = Row("`noack run` to the first control step", 0.7, "s", goal=Goal("<=", 0.6))
    rows = {
        "many_loops": [end],
        "size": [Row("C", 4000, "lines", goal=Goal("<=", 5000))],
        "startup": [start, Row("the same, against a bare import", 0.7, "s", Peer("Python", 0.2))],
    }
    figures = rows_of_goals(rows)
    assert figures == [start, end]
    page = tmp_path / "page.md"
    page.write_text(f"before\n{BEGIN}\nold\n{END}\nafter\n")
    write_docs(page, figures)
    lines = page.read_text().splitlines()
    assert (lines[0], lines[-1]) == ("before", "after")
    assert "| `noack run` to the first control step | 0.7 s |  |  | <= 0.6 | no |" in lines
    assert "| 1,000 loops: end of the run | 3 s | the run, 60 s | 0.05 | <= 0.1 | yes |" in lines
    page.write_text("no marks")
    with pytest.raises(SystemExit, match="marks"):
        write_docs(page, figures)


def test_the_page_is_not_written_without_all_goals(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (page := tmp_path / "page.md").write_text(f"{BEGIN}\nold\n{END}\n")
    row = Row("event → update, no emulator, p50", 30.0, "µs")
    with pytest.raises(SystemExit):
        run(by_name(named("latency", row)), ["latency", "--docs", str(page)])
    assert capsys.readouterr().err.splitlines()[-1].endswith("it needs the name 'goals'")
    assert "old" in page.read_text()


def test_every_goal_is_of_a_benchmark() -> None:
    assert set(GOALS) <= all_benchmarks().keys()


def test_a_parameter_is_set_and_rows_before_a_failure_are_kept(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def measure(count: int = 1) -> Iterator[Row]:
        yield Row("count", count, "")
        raise MeasurementError("no more")

    path, benchmarks = tmp_path / "rows.json", by_name(Benchmark("example", "Example", measure))
    assert run(benchmarks, ["--set", "count=3", "--json", str(path)]) == 1
    assert [(row["name"], row["value"]) for row in json.loads(path.read_text())][:2] == [
        ("count", 3),
        ("example", None),
    ]
    for wrong in ("count=x", "number=3"):
        with pytest.raises(SystemExit):
            run(benchmarks, ["--set", wrong])
        assert "expected NAME=VALUE of count" in capsys.readouterr().err
