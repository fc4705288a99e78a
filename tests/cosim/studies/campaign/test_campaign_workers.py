"""Local workers and a real Dask cluster: the same results for any number, though one is killed."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from cosim.studies.campaign import campaign_workers
from cosim.studies.campaign.arithmetic import arithmetic
from cosim.studies.campaign.campaign_workers import LostWorkersError, cluster_runner, run_in_process
from cosim.studies.campaign.chunk_store import Store, run_campaign
from netem.core.errors import CallerError, PeerError
from tests.cosim.studies.campaign.conftest import Command, Write, few_of
from tests.helpers.campaign_files import files
from tests.helpers.live_runs import command_of
from tests.helpers.waiting import wait_for

Start = Callable[[], "subprocess.Popen[str]"]
RUNS = 200
COMPUTE = """
import hashlib
import numpy as np
from noack.core.linear_systems import transition
generator = np.random.default_rng(1).normal(size=(66, 66))
print(hashlib.sha256(transition(generator, 2_000_000).tobytes()).hexdigest())
"""


def test_large_matrices_are_rounded_as_in_the_processes_of_a_run() -> None:
    """The exponential of a 66 x 66 matrix has different last bits on several threads."""
    outputs = set()
    for script, threads in ((f"import cosim.cli\n{COMPUTE}", "4"), (COMPUTE, "1")):
        environment = os.environ | {"OPENBLAS_NUM_THREADS": threads}
        outputs.add(subprocess.check_output([sys.executable, "-c", script], env=environment))
    assert len(outputs) == 1


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*.parquet")}


@pytest.fixture
def many(write: Write, plan: dict[str, Any]) -> Path:
    """A campaign with enough chunks to take seconds, even on a fast machine."""
    return write(plan, draws=50, chunk=1, figures=[])


def test_a_killed_worker_gives_one_line_and_no_byte_depends_on_the_workers(
    many: Path, tmp_path: Path
) -> None:
    _, points = few_of(many)
    by_two, reverse = (Store(tmp_path / name, points, 20, 1) for name in ("two", "reverse"))
    workers: list[psutil.Process] = []

    def progress(done: int, total: int) -> None:
        if done == 5:
            children = psutil.Process().children(recursive=True)
            workers.extend(child for child in children if "spawn_main" in " ".join(command_of(child)))
            workers[0].kill()

    with pytest.raises(LostWorkersError) as error, campaign_workers.local_runner(2) as runner:
        run_campaign(by_two, runner, progress)
    text = str(error.value)
    assert text.startswith("a worker process was killed (out of memory?); ")
    assert text.endswith("the same command continues the campaign")
    assert len(workers) == 2
    assert psutil.wait_procs(workers, timeout=60)[1] == []
    assert not list(by_two.folder.rglob(".*.partial"))
    run_campaign(reverse, lambda works, chunks: run_in_process(works, reversed(list(chunks))))
    finished_files = contents(by_two.folder)
    assert 5 <= len(finished_files) < 80
    assert run_campaign(by_two, run_in_process) == 80 - len(finished_files)
    assert finished_files.items() <= contents(by_two.folder).items()
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
    wait_for(lambda: len(files(folder)) >= count or process.poll() is not None)
    assert process.poll() is None, process.communicate()
    return psutil.Process(process.pid).children(recursive=True)


@pytest.mark.system
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
    result = run_command(many, "--json")
    assert result.exit_code == 0, result.output
    assert f'"made": {RUNS - len(before)}' in result.stdout
    assert files(folder).items() >= before.items()


START = "from distributed.cli.dask_{0} import main; main()"


class Cluster:
    """A scheduler, and workers that are started later."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started: list[subprocess.Popen[str]] = []
        self.scheduler = self._start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        assert self.scheduler.stderr is not None
        line = next(line for line in self.scheduler.stderr if "Scheduler at:" in line)
        self.address = line.split()[-1]

    def worker(self) -> "subprocess.Popen[str]":
        return self._start(
            "worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard",
            "--local-directory", str(self._folder), "--death-timeout", "20",
        )  # fmt: skip

    def _start(self, kind: str, *options: str) -> "subprocess.Popen[str]":
        pipe = subprocess.PIPE if kind == "scheduler" else subprocess.DEVNULL
        process = subprocess.Popen(
            [sys.executable, "-c", START.format(kind), *options],
            stdout=subprocess.DEVNULL, stderr=pipe, text=True, cwd=self._folder,
        )  # fmt: skip
        self._started.append(process)
        return process

    def close(self) -> None:
        for process in reversed(self._started):
            process.kill()
            process.communicate()


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Cluster]:
    pytest.importorskip("distributed")
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.close()


def killing(process: "subprocess.Popen[str]", count: int) -> Callable[[int, int], None]:
    """Return a progress function that kills a process when this number of runs is done."""

    def progress(done: int, total: int) -> None:
        if done >= count:
            process.kill()

    return progress


@pytest.mark.system
def test_a_cluster_from_its_first_worker_to_its_end(
    dask: Cluster, tmp_path: Path, write: Write, plan: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    _, points = few_of(write(plan, draws=30, chunk=2))
    here, there, unfinished = (
        Store(tmp_path / name, points, 30, 2) for name in ("here", "there", "unfinished")
    )
    lines: list[str] = []

    # Without a worker, the campaign reports that it waits, and ends.
    with monkeypatch.context() as patched:
        patched.setattr(campaign_workers, "_LOOK_EVERY_S", 0.1)
        patched.setattr(campaign_workers, "_PATIENCE_S", 0.5)
        with (
            pytest.raises(PeerError, match=r"the cluster has had no worker for 0\.5 s \(.*\); 0 of 120"),
            cluster_runner(dask.address, lines.append) as runner,
        ):
            run_campaign(there, runner)
    assert lines == [f"{dask.address}: no worker; waiting 0.5 s for one"]

    # A worker with different results is refused and named.
    first, second = dask.worker(), dask.worker()
    other = {**arithmetic(), "numpy": "1.0"}
    with monkeypatch.context() as patched:
        patched.setattr(campaign_workers, "arithmetic", lambda: other)
        with pytest.raises(PeerError) as error, cluster_runner(dask.address) as runner:
            run_campaign(there, runner)
    text = str(error.value)
    assert text.startswith(f"{dask.address}: a worker on ")
    assert f"would compute other results: numpy is {np.__version__} there, 1.0 here; 0 of" in text
    assert files(there.folder) == {}

    # The bytes are the same if a worker is killed.
    run_campaign(here, run_in_process)
    with cluster_runner(dask.address) as runner:
        assert run_campaign(there, runner, killing(first, 20)) == 120
    assert first.wait() != 0
    assert second.poll() is None
    assert contents(there.folder) == contents(here.folder)
    assert len(contents(there.folder)) == 60

    # A killed scheduler ends the campaign.
    with (
        pytest.raises(PeerError, match=r"the scheduler has ended; \d+ of 120 runs are in"),
        cluster_runner(dask.address) as runner,
    ):
        run_campaign(unfinished, runner, killing(dask.scheduler, 20))


def test_an_unreachable_or_invalid_scheduler_address_gives_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(campaign_workers, "_CONNECT_S", 0.5)
    with (
        pytest.raises(PeerError, match="no Dask scheduler answers there"),
        cluster_runner("tcp://127.0.0.1:9"),
    ):
        pass
    for address in ("nonsense://x:1", "foo", "", "tcp://x", "tcp://x:abc", "tcp://x:99999"):
        with pytest.raises(CallerError, match="write it as tcp://HOST:PORT"), cluster_runner(address):
            pass
