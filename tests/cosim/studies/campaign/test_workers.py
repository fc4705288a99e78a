"""Local worker processes: the same results for any number, and no harm from kills or interrupts."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from cosim.studies.campaign.campaign_file import Campaign
from cosim.studies.campaign.campaign_grid import Point
from cosim.studies.campaign.campaign_run import run_campaign
from cosim.studies.campaign.campaign_workers import alone, local
from cosim.studies.campaign.chunk_store import Store
from tests.cosim.studies.campaign.conftest import Write
from tests.cosim.studies.campaign.test_store import files

Few = tuple[Campaign, list[Point]]
Start = Callable[..., "subprocess.Popen[str]"]


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.parquet")}


def test_neither_workers_nor_the_order_of_chunks_change_a_byte(
    tmp_path: Path, campaign: Few
) -> None:
    plan, points = campaign
    stores = [Store(tmp_path / name, points, plan.draws, plan.chunk) for name in "abc"]
    run_campaign(stores[0], alone)
    with local(2) as runner:
        run_campaign(stores[1], runner)
    run_campaign(stores[2], lambda points, chunks: alone(points, reversed(list(chunks))))
    one, two, reverse = (contents(store.folder) for store in stores)
    assert len(one) == 12
    assert one == two == reverse


@pytest.fixture
def many(write: Write, plan: dict[str, Any]) -> Path:
    """A campaign with enough chunks to take seconds, even on a fast machine."""
    return write(plan, draws=80, chunk=1)


@pytest.fixture
def start(many: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts the command on it, with two processes by default."""
    started = []

    def begin(*options: str) -> "subprocess.Popen[str]":
        words = [sys.executable, "-m", "cosim.cli", "campaign", str(many), "--json"]
        process = subprocess.Popen(
            [*words, "--out", str(tmp_path / "out"), *(options or ("--workers", "2"))],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        )  # fmt: skip
        started.append(process)
        return process

    yield begin
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def wait_for_files(folder: Path, count: int, process: "subprocess.Popen[str]") -> None:
    while len(files(folder)) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)


def offspring(process: "subprocess.Popen[str]") -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def test_a_killed_campaign_continues_where_it_stopped(start: Start, tmp_path: Path) -> None:
    folder = tmp_path / "out"
    killed = start()
    wait_for_files(folder, 10, killed)
    children = offspring(killed)
    killed.kill()
    killed.communicate()
    _, alive = psutil.wait_procs(children, timeout=60)
    assert alive == []
    before = files(folder)
    assert 10 <= len(before) < 320
    ended = start()
    out, err = ended.communicate()
    assert ended.returncode == 0, err
    assert f'"made": {320 - len(before)}' in out
    after = files(folder)
    assert {name: after[name] for name in before} == before
    again = start("--workers", "1")
    assert again.communicate()[0].replace('"made": 0', "") == out.replace(
        f'"made": {320 - len(before)}', ""
    )
    assert files(folder) == after


def test_ctrl_c_ends_a_campaign_with_one_line_on_how_to_continue(
    start: Start, tmp_path: Path
) -> None:
    process = start()
    wait_for_files(tmp_path / "out", 5, process)
    children = offspring(process)
    os.killpg(process.pid, signal.SIGINT)  # as a terminal does: the signal goes to all processes
    _, err = process.communicate()
    assert process.returncode == 130
    assert err.count("\n") == 1, err
    line = err.strip()
    done = len(files(tmp_path / "out"))
    assert line == (
        f"noack: interrupted; {done} of 320 runs are in {tmp_path / 'out'}; "
        "the same command continues the campaign"
    )
    assert psutil.wait_procs(children, timeout=60)[1] == []


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_all_processes_ends_a_campaign_with_one_line(
    start: Start, tmp_path: Path, number: signal.Signals
) -> None:
    process = start()
    wait_for_files(tmp_path / "out", 5, process)
    children = offspring(process)
    os.killpg(process.pid, number)
    _, err = process.communicate()
    assert process.returncode == 143
    lines = [line for line in err.splitlines() if line.startswith("noack: ")]
    assert lines[0].startswith(f"noack: ended by {number.name}; ") or lines[0].startswith(
        "noack: a worker process was killed"  # a worker may receive it first
    )
    assert lines[0].endswith("the same command continues the campaign")
    assert "Traceback" not in err
    assert psutil.wait_procs(children, timeout=60)[1] == []


def test_a_killed_worker_gives_one_line_without_a_hang(start: Start, tmp_path: Path) -> None:
    process = start()
    wait_for_files(tmp_path / "out", 5, process)
    workers = [p for p in offspring(process) if "spawn_main" in " ".join(p.cmdline())]
    assert len(workers) == 2
    workers[0].kill()
    _, err = process.communicate()
    assert process.returncode == 1
    assert err.count("\n") == 1, err
    line = err.strip()
    assert line.startswith("noack: a worker process was killed (out of memory?); ")
    assert line.endswith("the same command continues the campaign")
    assert psutil.wait_procs(workers, timeout=60)[1] == []
    assert not list((tmp_path / "out").rglob(".*.partial"))
