"""Local worker processes: the same results for any number, and no harm from kills or interrupts."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import psutil
import pytest

from cosim.studies.campaign import campaign_workers
from cosim.studies.campaign.campaign_workers import Chunk, Finished, LostWorkersError, Work, alone
from cosim.studies.campaign.chunk_store import Store, run_campaign
from tests.cosim.studies.campaign.conftest import Command, Write, few_of
from tests.cosim.studies.campaign.test_store import files

Start = Callable[[], "subprocess.Popen[str]"]
RUNS = 320
COMPUTE = """
import hashlib
import numpy as np
from noack.core.linear_systems import transition
generator = np.random.default_rng(1).normal(size=(66, 66))
print(hashlib.sha256(transition(generator, 2_000_000).tobytes()).hexdigest())
"""


def test_large_matrices_are_rounded_as_in_the_processes_of_a_run() -> None:
    """The exponential of a 66 x 66 matrix has different last bits on several threads."""
    found = set()
    for script, threads in ((f"import cosim.cli\n{COMPUTE}", "4"), (COMPUTE, "1")):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads}
        found.add(subprocess.check_output([sys.executable, "-c", script], env=environment))
    assert len(found) == 1


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.parquet")}


@pytest.fixture
def many(write: Write, plan: dict[str, Any]) -> Path:
    """A campaign with enough chunks to take seconds, even on a fast machine."""
    return write(plan, draws=80, chunk=1, figures=[])


def test_a_killed_worker_gives_one_line_and_no_byte_depends_on_the_workers(
    many: Path, tmp_path: Path
) -> None:
    _, points = few_of(many)
    by_two, reverse = (Store(tmp_path / name, points, 80, 1) for name in ("two", "reverse"))
    workers: list[psutil.Process] = []

    def progress(done: int, total: int) -> None:
        if done == 5:
            children = psutil.Process().children(recursive=True)
            workers.extend(p for p in children if "spawn_main" in " ".join(p.cmdline()))
            workers[0].kill()

    with pytest.raises(LostWorkersError) as lost, campaign_workers.local(2) as runner:
        run_campaign(by_two, runner, progress)
    text = str(lost.value)
    assert text.startswith("a worker process was killed (out of memory?); ")
    assert text.endswith("the same command continues the campaign")
    assert len(workers) == 2
    assert psutil.wait_procs(workers, timeout=60)[1] == []
    assert not list(by_two.folder.rglob(".*.partial"))
    run_campaign(reverse, lambda works, chunks: alone(works, reversed(list(chunks))))
    begun = contents(by_two.folder)
    assert 5 <= len(begun) < RUNS
    assert run_campaign(by_two, alone) == RUNS - len(begun)
    assert begun.items() <= contents(by_two.folder).items()
    assert contents(by_two.folder) == contents(reverse.folder)


@pytest.fixture
def start(many: Path, tmp_path: Path) -> Iterator[Start]:
    """Starts the command with two processes."""
    started = []

    def begin() -> "subprocess.Popen[str]":
        words = [sys.executable, "-m", "cosim.cli", "campaign", str(many), "--workers", "2"]
        process = subprocess.Popen(
            [*words, "--out", str(tmp_path / "out")], start_new_session=True, text=True,
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        )  # fmt: skip
        started.append(process)
        return process

    yield begin
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def when_files(folder: Path, count: int, process: "subprocess.Popen[str]") -> list[psutil.Process]:
    """Wait for this number of files; return the children of the process."""
    while len(files(folder)) < count:
        assert process.poll() is None, process.communicate()
        time.sleep(0.01)
    return psutil.Process(process.pid).children(recursive=True)


def test_an_interrupted_and_then_killed_campaign_continues_where_it_stopped(
    start: Start, many: Path, tmp_path: Path, run_command: Command
) -> None:
    folder = tmp_path / "out"
    interrupted = start()
    children = when_files(folder, 5, interrupted)
    os.killpg(interrupted.pid, signal.SIGINT)  # as a terminal does: to all processes
    _, err = interrupted.communicate()
    assert interrupted.returncode == 130
    assert err.splitlines(keepends=True)[-1] == (  # lines of progress may be before it
        f"noack: stopped by the user (SIGINT); {len(files(folder))} of {RUNS} runs are in "
        f"{folder}; the same command continues the campaign\n"
    )
    assert psutil.wait_procs(children, timeout=60)[1] == []
    killed = start()
    children = when_files(folder, len(files(folder)) + 5, killed)
    killed.kill()
    killed.communicate()
    assert psutil.wait_procs(children, timeout=60)[1] == []
    before = files(folder)
    assert 10 <= len(before) < RUNS
    ended = run_command(many, "--json")
    assert ended.exit_code == 0, ended.output
    assert f'"made": {RUNS - len(before)}' in ended.stdout
    assert files(folder).items() >= before.items()


@pytest.mark.usefixtures("usual_signals")
def test_a_signal_ends_a_campaign_with_one_line(
    many: Path, tmp_path: Path, run_command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    def signalled(works: Sequence[Work], chunks: Iterable[Chunk]) -> Iterator[Finished]:
        for i, finished in enumerate(alone(works, chunks)):
            if i == 5:
                signal.raise_signal(signal.SIGTERM)
            yield finished

    monkeypatch.setattr(campaign_workers, "alone", signalled)
    ended = run_command(many)
    assert ended.exit_code == 143
    assert ended.stderr.splitlines()[-1] == (
        f"noack: stopped on request (SIGTERM); 5 of {RUNS} runs are in {tmp_path / 'out'}; "
        "the same command continues the campaign"
    )
