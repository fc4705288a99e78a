"""A soak test of a few seconds; only a longer one can show whether memory is flat."""

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.soak import (
    FOLDER,
    PICTURE_FILE,
    RESULT_FILE,
    ROLES,
    Result,
    constant,
    ended_badly,
    main,
    size_bytes,
    soak,
    trend,
    warm_up_s,
)
from cosim.record.run_record import load_record

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
        found = soak(FOLDER / "soak_day.toml", settings, runs, told.append)
        if set(found.watched) == {*ROLES} and not faults_of(found):
            break
    assert told
    return found


def test_every_process_is_watched(result: Result) -> None:
    assert set(result.watched) == {*ROLES}
    for watched in result.watched.values():
        assert all(sample.uss_kib > 1000 and sample.threads >= 1 for sample in watched.samples)


def faults_of(result: Result) -> list[str]:
    stale = int(load_record(result.run_dir)["netem_release"]["stale"].sum())
    return [*ended_badly(result.summary, 0, stale)]


def test_a_real_run_has_no_faults_at_its_end(result: Result) -> None:
    assert result.loop["events"] > 100
    record = load_record(result.run_dir)
    assert len(record["plant_step"]) == record.scenario.horizon_s * 20 + 1
    assert faults_of(result) == []


def test_a_soak_test_writes_figures_and_a_picture(result: Result) -> None:
    assert result.run_dir is not None
    written = json.loads((result.run_dir / RESULT_FILE).read_text())
    assert set(written["processes"]) == {*ROLES}
    assert (result.run_dir / PICTURE_FILE).read_bytes().startswith(b"\x89PNG")


def test_a_good_end_has_no_faults() -> None:
    assert not [*ended_badly(summary(), 0)]


def test_stale_rejections_must_equal_the_packets_delivered_out_of_order() -> None:
    stale = summary(rejected_datagrams={"controller": {"stale": 3}})
    assert not [*ended_badly(stale, 0, 3)]
    assert [len([*ended_badly(stale, 0, number)]) for number in (0, 2)] == [1, 1]


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
    faults = [*ended_badly(summary(**{key: value}), 0)]
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


HOUR_S = 3600.0


def judged(kib_of_s, length_s: float = HOUR_S, every_s: float = 5.0):  # type: ignore[no-untyped-def]
    at_s = np.arange(0.0, length_s, every_s)
    return trend(at_s.tolist(), [float(kib_of_s(t)) for t in at_s], length_s)


def noise(t: float) -> float:
    """Return an allocator's fluctuation: ± 300 KiB, faster than a window."""
    return 300 * math.sin(t) * math.cos(0.37 * t)


def test_fluctuating_memory_is_flat() -> None:
    found = judged(lambda t: 80_000 + noise(t))
    assert found.verdict == "flat"
    assert abs(found.growth_kib) < 100


@pytest.mark.parametrize("bytes_per_step", [2.0, 10.0, 88.0])
def test_a_leak_per_step_is_reported_as_growth(bytes_per_step: float) -> None:
    found = judged(lambda t: 80_000 + noise(t) + 500 * t * bytes_per_step / 1024)
    assert found.verdict == "grows"
    assert found.slope_kib_per_h == pytest.approx(3600 * 500 * bytes_per_step / 1024, rel=0.1)


def test_a_leak_per_event_is_reported_as_slow_growth_after_an_hour() -> None:
    found = judged(lambda t: 80_000 + 0.1 * t)  # 0.8 events per second, 128 bytes each
    assert found.growth_kib < found.allowed_kib
    assert found.verdict == "creeps"


def test_five_minutes_suffice_for_a_leak_per_step_but_not_for_slower_leaks() -> None:
    assert judged(lambda t: 80_000 + 500 * t * 88 / 1024, 300.0).verdict == "grows"
    assert judged(lambda t: 80_000 + 0.1 * t, 300.0).verdict == "flat"


def test_one_minute_is_too_short_for_a_verdict() -> None:
    assert judged(lambda t: 80_000 + 500 * t * 88 / 1024, 60.0).verdict == "too short"


def test_the_warm_up_is_not_judged() -> None:
    assert warm_up_s(HOUR_S) == 300.0
    assert judged(lambda t: 80_000 + 50 * min(t, 300.0)).verdict == "flat"


def test_temporary_memory_is_not_growth() -> None:
    assert judged(lambda t: 80_000 + (20_000 if t % 600 < 60 else 0)).verdict == "flat"


def test_a_longer_run_is_judged_by_its_growth_rate() -> None:
    assert judged(lambda t: 80_000 + noise(t) + 0.2 * t, 24 * HOUR_S, 60.0).verdict != "grows"
    assert judged(lambda t: 80_000 + noise(t) + 0.4 * t, 24 * HOUR_S, 60.0).verdict == "grows"


def test_too_few_samples_give_no_verdict() -> None:
    assert judged(lambda t: 80_000, HOUR_S, 900.0).verdict == "unknown"
    assert trend([], [], HOUR_S).verdict == "unknown"


def test_memory_is_reported_at_shares_of_the_run() -> None:
    found = judged(lambda t: t)
    assert (found.at_10_kib, found.at_50_kib, found.at_100_kib) == (360.0, 1800.0, 3595.0)


def test_changes_of_a_count_are_found_after_the_warm_up_only() -> None:
    at_s = [0.0, 30.0, 70.0, 80.0, 99.0]
    assert constant([30.0, 40.0, *at_s[2:]], [9, 9, 7, 7, 7], 100.0) == (7, 9)
    assert constant([30.0, 40.0, *at_s[2:]], [7, 7, 8, 7, 7], 100.0) == (7, 7)
    assert constant(at_s, [3, 7, 7, 7, 7], 100.0) == (7, 7)


def test_a_folder_may_vanish_while_it_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "log").write_bytes(bytes(8192))
    (tmp_path / "spool").mkdir()
    (tmp_path / "spool" / "rows").write_bytes(bytes(8192))
    assert size_bytes(tmp_path) >= 2 * 8192
    look = Path.stat

    def look_once_more(path: Path) -> object:
        if path.name == "rows":
            shutil.rmtree(tmp_path / "spool", ignore_errors=True)
        return look(path)

    monkeypatch.setattr(Path, "stat", look_once_more)
    assert 8192 <= size_bytes(tmp_path) < 2 * 8192
