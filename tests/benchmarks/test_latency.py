"""The bare pings, and the rows of the latency beside them."""

import shutil
from pathlib import Path

import pytest

from benchmarks import latency
from benchmarks.bare_programs import command_of
from benchmarks.latency import ping
from benchmarks.programs import compiled
from benchmarks.report import MeasurementError, Rounds

NAME = next(iter(latency.CASES))


@pytest.mark.parametrize("language", ["C", "Python"])
@pytest.mark.parametrize("asked", [False, True])
def test_every_datagram_of_a_ping_arrives(language: str, asked: bool, tmp_path: Path) -> None:
    if language == "C" and shutil.which("cc") is None:
        pytest.skip("cc is not installed")
    command = command_of("ping") if language == "Python" else [str(compiled("ping.c", tmp_path))]
    found, refused = ping(command, 20, 0.002, asked=asked)
    assert found["count"] == 20
    assert 0 < found["p50"] <= found["p99"]
    known = {"memory_lock", "timer_slack", "sched_fifo", "affinity", "cpu_dma_latency"}
    assert refused <= (known if asked else set())


def test_a_program_that_fails_gives_no_figure() -> None:
    with pytest.raises(MeasurementError, match="did not end"):
        ping(["false"], 1, 0.001, asked=False)


def rounds_of(**sides: tuple[float, float]) -> Rounds:
    rounds = Rounds()
    for side, (p50, p99) in sides.items():
        rounds.add(side, {"p50": p50, "p99": p99, "count": 100})
    return rounds


def test_the_ping_in_c_is_the_measure_of_both_quantiles() -> None:
    rounds = rounds_of(**{
        latency.OURS: (28.0, 90.0), latency.C_PING: (20.0, 40.0), latency.PYTHON_PING: (14.0, 45.0),
    })  # fmt: skip
    p50, p99, *plain = latency.rows_of(NAME, rounds, {"sched_fifo"})
    assert (p50.ratio, p50.holds) == (pytest.approx(1.4), True)
    assert (p99.ratio, p99.holds) == (2.25, False)
    assert [row.ratio for row in plain] == [2.0, 2.0]
    assert all(row.goal is None for row in plain)
    assert "100 updates; 100 and 100 pings; not applied: sched_fifo" in p50.as_json()["note"]


def test_without_a_compiler_the_goals_are_not_judged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(shutil, "which", lambda name: None)
    rounds = rounds_of(**{latency.OURS: (28.0, 90.0), latency.PYTHON_PING: (14.0, 45.0)})
    with pytest.raises(MeasurementError) as reason:
        compiled("ping.c", tmp_path)
    rounds.add(latency.C_PING, str(reason.value))
    p50, p99, *plain = latency.rows_of(NAME, rounds, set())
    assert p50.holds is p99.holds is None
    assert "cc is not installed" in p50.as_json()["note"]
    assert [row.ratio for row in plain] == [2.0, 2.0]
