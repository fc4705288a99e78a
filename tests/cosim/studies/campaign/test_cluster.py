"""A real Dask cluster of local processes, which are killed one after the other."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.studies.campaign import campaign_workers
from cosim.studies.campaign.campaign_workers import alone, arithmetic, cluster
from cosim.studies.campaign.chunk_store import Store, run_campaign
from noack.core.errors import CallerError, PeerError
from tests.cosim.studies.campaign.conftest import Command, Write, few_of
from tests.cosim.studies.campaign.test_store import files
from tests.cosim.studies.campaign.test_workers import contents

distributed = pytest.importorskip("distributed")

START = "from distributed.cli.dask_{0} import main; main()"


class Cluster:
    """A scheduler, and workers that are started later."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._started: list[subprocess.Popen[str]] = []
        self.scheduler = self._start(
            "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"
        )
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
    cluster = Cluster(tmp_path)
    yield cluster
    cluster.close()


def killing(process: "subprocess.Popen[str]", count: int) -> Callable[[int, int], None]:
    """Return a progress function that kills a process when this number of runs is done."""

    def progress(done: int, total: int) -> None:
        if done >= count:
            process.kill()

    return progress


def test_a_cluster_from_its_first_worker_to_its_end(
    dask: Cluster, tmp_path: Path, write: Write, plan: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    _, points = few_of(write(plan, draws=60, chunk=2))
    here, there, unfinished = (
        Store(tmp_path / name, points, 60, 2) for name in ("here", "there", "unfinished")
    )
    lines: list[str] = []

    # Without a worker, the campaign reports that it waits, and ends.
    with monkeypatch.context() as patched:
        patched.setattr(campaign_workers, "_LOOK_EVERY_S", 0.1)
        patched.setattr(campaign_workers, "_PATIENCE_S", 0.5)
        with (
            pytest.raises(
                PeerError, match=r"the cluster has had no worker for 0\.5 s \(.*\); 0 of 240"
            ),
            cluster(dask.address, lines.append) as runner,
        ):
            run_campaign(there, runner)
    assert lines == [f"{dask.address}: no worker; waiting 0.5 s for one"]

    # A worker with different results is refused and named.
    first, second = dask.worker(), dask.worker()
    other = {**arithmetic(), "numpy": "1.0"}
    with monkeypatch.context() as patched:
        patched.setattr(campaign_workers, "arithmetic", lambda: other)
        with pytest.raises(PeerError) as refused, cluster(dask.address) as runner:
            run_campaign(there, runner)
    text = str(refused.value)
    assert text.startswith(f"{dask.address}: a worker on ")
    assert f"would compute other results: numpy is {np.__version__} there, 1.0 here; 0 of" in text
    assert files(there.folder) == {}

    # The bytes are the same if a worker is killed.
    run_campaign(here, alone)
    with cluster(dask.address) as runner:
        assert run_campaign(there, runner, killing(first, 40)) == 240
    assert first.wait() != 0
    assert second.poll() is None
    assert contents(there.folder) == contents(here.folder)
    assert len(contents(there.folder)) == 120

    # A killed scheduler ends the campaign.
    with (
        pytest.raises(PeerError, match=r"the scheduler has ended; \d+ of 240 runs are in"),
        cluster(dask.address) as runner,
    ):
        run_campaign(unfinished, runner, killing(dask.scheduler, 20))


def test_an_unreachable_or_invalid_scheduler_address_gives_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(campaign_workers, "_CONNECT_S", 0.5)
    with (
        pytest.raises(PeerError, match="no Dask scheduler answers there"),
        cluster("tcp://127.0.0.1:9"),
    ):
        pass
    for address in ("nonsense://x:1", "foo", "", "tcp://x", "tcp://x:abc", "tcp://x:99999"):
        with pytest.raises(CallerError, match="write it as tcp://HOST:PORT"), cluster(address):
            pass


def test_only_a_campaign_with_a_scheduler_imports_dask(
    write: Write, plan: dict[str, Any], run_command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("distributed", "dask"):
        monkeypatch.setitem(sys.modules, module, None)
    done = run_command(write(plan, draws=1, figures=[]))
    assert done.exit_code == 0, done.output
    with pytest.raises(CallerError, match=r"pip install 'noack\[cluster\]'"), cluster("x:1"):
        pass
