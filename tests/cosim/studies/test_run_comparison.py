"""Comparison of runs: numbers, settings, distance, one figure; and runs that cannot be compared."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

import noack
from cosim.studies.run_comparison import KeyNumber, RunComparison, compare_runs
from noack.protocol.record_tables import PLANT_STEP
from tests.helpers.command_line import invoke

SETTINGS: list[dict[str, Any]] = [
    {"horizon_s": 3.0},
    {"horizon_s": 3.0, "mode": "zoh"},
    {"horizon_s": 2.0, "network.mansd": 1, "plant.rate_hz": 250.0},
]


@pytest.fixture(scope="module")
def simulated() -> list[noack.Run]:
    return [finalized(noack.load("lane_following", settings)) for settings in SETTINGS]


def finalized(scenario: noack.Scenario) -> noack.Run:
    """A run without report and recording, which `noack compare` would write first."""
    run = noack.simulate(scenario)
    assert run.summary
    return run


@pytest.fixture(scope="module")
def runs(simulated: list[noack.Run]) -> list[Path]:
    return [run.directory for run in simulated]


@pytest.fixture(scope="module")
def comparison(runs: list[Path]) -> RunComparison:
    return compare_runs(runs)


def compare(*words: object) -> Result:
    return invoke("compare", *words)


def number(comparison: RunComparison, name: str) -> KeyNumber:
    return next(key_number for key_number in comparison.numbers if key_number.name == name)


def test_numbers_are_those_of_the_summaries_with_differences_to_the_first_run(
    comparison: RunComparison,
) -> None:
    assert comparison.settings["mode"] == ("model", "zoh", "model")
    assert comparison.settings["plant.rate_hz"] == ("500.0", "500.0", "250.0")
    assert "trigger.beta" not in comparison.settings
    events = tuple(run.loop.events for run in comparison.runs)
    assert number(comparison, "transmissions").values == events
    assert number(comparison, "transmissions").differences == (0, *(n - events[0] for n in events[1:]))
    for run, share in zip(comparison.runs, number(comparison, "loss rate, %").values, strict=True):
        crossed = run.loop.drops + run.loop.deliveries
        assert share == pytest.approx(100 * run.loop.drops / crossed)


def test_the_distance_is_over_the_common_times(comparison: RunComparison) -> None:
    """The third run takes every second step of the first, for two of its three seconds."""
    first, _, third = (run.record[PLANT_STEP] for run in comparison.runs)
    assert len(third) == 501
    apart = np.linalg.norm(third["x"] - first["x"][:1001:2], axis=1)
    rms, largest = (number(comparison, f"distance in x to A, {name}") for name in ("RMS", "maximum"))
    assert rms.values[0] is largest.values[0] is None
    assert rms.values[2] == pytest.approx(np.sqrt(np.mean(apart**2)))
    assert largest.values[2] == pytest.approx(apart.max())


def test_the_command_prints_the_table_and_writes_an_escaped_page(runs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "new" / "overlay.html"
    result = compare(*runs, "--out", out)
    assert result.exit_code == 0, result.output
    assert "transmissions" in result.stdout
    assert "network.mansd" in result.stdout
    assert result.stdout.splitlines()[-1] == f"overlay: {out}"
    assert list(out.parent.iterdir()) == [out]
    html = out.read_text()
    assert html.startswith("<!DOCTYPE html>")
    assert html.count("<svg") == 2  # for wide and narrow screens
    assert "<script" not in html
    assert "zero-order hold" in html
    result = compare(*runs[:2], "--out", tmp_path / "a.svg", "--json")
    document = json.loads(result.stdout)
    first, second = document["numbers"]["deliveries"]
    assert document["differences"]["deliveries"] == [0, second - first]
    assert document["settings"]["mode"] == ["model", "zoh"]
    assert Path(document["overlay"]).read_bytes().startswith(b"<?xml")
    mine = noack.compare(*map(noack.open_run, runs))
    assert mine.rows == compare_runs(runs).rows
    assert "distance in x to A, RMS" in repr(mine)


def test_the_page_is_written_beside_the_first_run(
    runs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    first, second = tmp_path / "first/A", tmp_path / "second/B"
    for run, copy in zip(runs, (first, second), strict=False):
        shutil.copytree(run, copy)
    result = compare("../first/A", second)
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[-1] == "overlay: ../first/comparison.html"
    assert sorted(path.name for path in first.parent.iterdir()) == ["A", "comparison.html"]
    assert not [*here.iterdir()]


def test_runs_that_cannot_be_compared_give_one_line(runs: list[Path], tmp_path: Path) -> None:
    other = finalized(noack.load("double_integrator", {"horizon_s": 0.2}))
    mistakes = {
        (runs[0], other.directory): f"noack: {other.directory}: its plant has 2 states, that of "
        f"{runs[0]} has 4; runs with equally many states can be compared\n",
        (runs[0],): "noack: give 2 to 7 run directories to compare, not 1\n",
        (runs[0], tmp_path): f"noack: {tmp_path}: not a run directory (no scenario.toml)\n",
        (*runs, "--out", tmp_path / "a.eps"): f"noack: {tmp_path / 'a.eps'}: a comparison is "
        "written as .html, .svg, .png, .pdf\n",
    }
    for words, message in mistakes.items():
        result = compare(*words)
        assert (result.exit_code, result.stderr, result.stdout) == (2, message, "")
