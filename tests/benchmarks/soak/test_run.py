"""A soak test of a few seconds; only a longer one can show whether memory is flat."""

import json
from pathlib import Path
from typing import Any

import pytest

import benchmarks.soak
from benchmarks.soak.__main__ import main
from benchmarks.soak.run import PICTURE_FILE, RESULT_FILE, Result, ended_badly, soak
from cosim.record.run_record import load_record

FOLDER = Path(benchmarks.soak.__file__).parent
ROLES = {"plant", "sensor", "netem", "controller", "recorder", "launcher"}
GOOD: dict[str, Any] = {
    "exit": {"status": 0, "reason": "horizon"},
    "missing_samples": 0,
    "unintended_losses": 0,
    "rejected_datagrams": {},
    "assumption_violations": [],
    "replay": {"bit_exact": True, "complete": True, "inputs": 7},
    "claims": [
        {"verdict": "held", "since_s": None, "what": "a", "source": "b", "why": ""},
        {"verdict": "not applicable", "since_s": 1.0, "what": "a", "source": "b", "why": "ideal"},
        {"verdict": "void", "since_s": 1.0, "what": "a", "source": "b", "why": "late"},
    ],
}


def summary(**changed: Any) -> dict[str, Any]:
    """The summary of a good run of one loop, with other values."""
    end = {"exit": changed.pop("exit", GOOD["exit"])}
    return end | {"loops": [GOOD | changed]}


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    runs = tmp_path_factory.mktemp("runs")
    told: list[str] = []
    for horizon_s in (96, 384, 384, 384):  # a machine that stalls may spoil a run, or its samples
        settings = (f"horizon_s={horizon_s}", "speed=24")
        found = soak(FOLDER / "day.toml", settings, runs, told.append)
        if set(found.watched) == ROLES and not faults_of(found):
            break
    assert told
    return found


def test_every_process_is_watched(result: Result) -> None:
    assert set(result.watched) == ROLES
    for watched in result.watched.values():
        assert all(sample.uss_kib > 1000 and sample.threads >= 1 for sample in watched.samples)


def faults_of(result: Result) -> list[str]:
    stale = int(load_record(result.run_dir)["netem_release"]["stale"].sum())
    return ended_badly(result.summary, 0, stale)


def test_a_real_run_has_no_faults_at_its_end(result: Result) -> None:
    assert result.loop["events"] > 100
    record = load_record(result.run_dir)
    assert len(record["plant_step"]) == record.scenario.horizon_s * 20 + 1
    assert faults_of(result) == []


def test_a_soak_test_writes_figures_and_a_picture(result: Result) -> None:
    assert result.run_dir is not None
    written = json.loads((result.run_dir / RESULT_FILE).read_text())
    assert set(written["processes"]) == ROLES
    assert (result.run_dir / PICTURE_FILE).read_bytes().startswith(b"\x89PNG")


def test_a_good_end_has_no_faults() -> None:
    assert ended_badly(summary(), 0) == []


def test_stale_rejections_must_equal_the_packets_delivered_out_of_order() -> None:
    stale = summary(rejected_datagrams={"controller": {"stale": 3}})
    assert ended_badly(stale, 0, 3) == []
    assert [len(ended_badly(stale, 0, number)) for number in (0, 2)] == [1, 1]


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("exit", {"status": 1, "reason": "plant: too slow"}, "too slow"),
        ("missing_samples", 3, "missing_samples: 3"),
        ("unintended_losses", 1, "unintended_losses: 1"),
        ("rejected_datagrams", {"plant": {"tag": 1}}, "rejected_datagrams"),
        ("assumption_violations", [{"cause": "dropouts", "what": "MANSD violated"}], "MANSD"),
        ("replay", {"bit_exact": False, "complete": True, "inputs": 7}, "the replay"),
        ("replay", None, "the replay"),
        ("claims", [], "no claim"),
        ("claims", [GOOD["claims"][1] | {"verdict": "violated"}], "violated since 1.0 s"),
    ],
)
def test_each_fault_in_the_summary_is_reported(key: str, value: object, told: str) -> None:
    faults = ended_badly(summary(**{key: value}), 0)
    assert len(faults) == 1
    assert told in faults[0]


@pytest.mark.parametrize("arguments", [["week"], ["--minutes", "x"], ["--minutes", "nan"]])
def test_a_mistake_on_the_command_line_is_reported(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "error: " in capsys.readouterr().err


def test_a_run_that_cannot_start_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = ["--set", "network.mansd=-1"]
    assert main(["--minutes", "1", "--runs", str(tmp_path), *settings]) == 2
    assert "network.mansd" in capsys.readouterr().err
