"""A real Dask cluster of local processes, one of which is killed during the run."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.studies.campaign.campaign_file import Campaign, load
from cosim.studies.campaign.campaign_grid import Point, grid
from cosim.studies.campaign.campaign_run import run_campaign
from cosim.studies.campaign.campaign_workers import alone, cluster
from cosim.studies.campaign.chunk_store import Store
from cosim.studies.campaign.worker_identity import arithmetic
from noack.core.errors import CallerError, PeerError
from tests.cosim.studies.campaign.conftest import Write
from tests.cosim.studies.campaign.test_store import files
from tests.cosim.studies.campaign.test_workers import contents

distributed = pytest.importorskip("distributed")

START = "from distributed.cli.dask_{0} import main; main()"


class Cluster:
    """A scheduler and workers."""

    def __init__(self, folder: Path, workers: int = 2) -> None:
        self._folder = folder
        scheduler = self.start("scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        assert scheduler.stderr is not None
        line = next(line for line in scheduler.stderr if "Scheduler at:" in line)
        self.address = line.split()[-1]
        self.scheduler = scheduler
        self.workers = [self.worker() for _ in range(workers)]

    def worker(self) -> "subprocess.Popen[str]":
        return self.start(
            "worker", self.address, "--nthreads", "1", "--no-nanny", "--no-dashboard",
            "--local-directory", str(self._folder), "--death-timeout", "20",
        )  # fmt: skip

    def start(self, kind: str, *options: str) -> "subprocess.Popen[str]":
        pipe = subprocess.PIPE if kind == "scheduler" else subprocess.DEVNULL
        return subprocess.Popen(
            [sys.executable, "-c", START.format(kind), *options],
            stdout=subprocess.DEVNULL, stderr=pipe, text=True, cwd=self._folder,
        )  # fmt: skip

    def close(self) -> None:
        for process in (*self.workers, self.scheduler):
            process.kill()
            process.communicate()


@pytest.fixture(scope="module")
def dask(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    running = Cluster(tmp_path_factory.mktemp("dask"))
    yield running
    running.close()


@pytest.fixture
def some(write: Write, plan: dict[str, Any]) -> tuple[Campaign, list[Point]]:
    path = write(plan, draws=60, chunk=2)
    loaded = load(path)
    return loaded, grid(loaded, path)


def test_a_cluster_gives_the_same_bytes_after_a_worker_is_killed(
    dask: Cluster, tmp_path: Path, some: tuple[Campaign, list[Point]]
) -> None:
    plan, points = some
    here, there = (
        Store(tmp_path / name, points, plan.draws, plan.chunk) for name in ("here", "there")
    )
    run_campaign(here, alone)
    told = []

    def progress(done: int, total: int) -> None:
        told.append(done)
        if len(told) == 20:
            dask.workers[0].kill()

    with cluster(dask.address) as runner:
        assert run_campaign(there, runner, progress) == 240
    assert dask.workers[0].wait() != 0
    assert dask.workers[1].poll() is None
    assert told[-1] == 240
    assert contents(there.folder) == contents(here.folder)
    assert len(contents(there.folder)) == 120


def test_a_worker_with_different_results_is_refused_and_named(
    dask: Cluster, tmp_path: Path, some: tuple[Campaign, list[Point]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    plan, points = some
    store = Store(tmp_path / "out", points, plan.draws, plan.chunk)
    other = {**arithmetic(), "numpy": "1.0"}
    monkeypatch.setattr("cosim.studies.campaign.campaign_workers.arithmetic", lambda: other)
    with (
        pytest.raises(PeerError) as found,
        cluster(dask.address) as runner,
    ):
        run_campaign(store, runner)
    text = str(found.value)
    assert text.startswith(f"{dask.address}: a worker on ")
    assert f"would compute other results: numpy is {np.__version__} there, 1.0 here; 0 of" in text
    assert files(store.folder) == {}


def test_waiting_for_workers_is_reported_and_limited(
    tmp_path: Path, some: tuple[Campaign, list[Point]], monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, points = some
    said: list[str] = []
    empty = Cluster(tmp_path, workers=0)
    monkeypatch.setattr("cosim.studies.campaign.campaign_workers._LOOK_EVERY_S", 0.1)
    monkeypatch.setattr("cosim.studies.campaign.campaign_workers._PATIENCE_S", 0.5)
    try:
        with (
            pytest.raises(
                PeerError, match=r"the cluster has had no worker for 0\.5 s \(.*\); 0 of 240"
            ),
            cluster(empty.address, said.append) as runner,
        ):
            run_campaign(Store(tmp_path / "out", points, plan.draws, plan.chunk), runner)
    finally:
        empty.close()
    assert said == [f"{empty.address}: no worker; waiting 0.5 s for one"]


def test_an_unreachable_or_invalid_scheduler_address_gives_one_line(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("cosim.studies.campaign.campaign_workers._CONNECT_S", 0.5)
    with (
        pytest.raises(PeerError, match="no Dask scheduler answers there"),
        cluster("tcp://127.0.0.1:9"),
    ):
        pass
    for address in ("nonsense://x:1", "foo", "", "tcp://x", "tcp://x:abc", "tcp://x:99999"):
        with pytest.raises(CallerError, match="write it as tcp://HOST:PORT"), cluster(address):
            pass


def test_without_dask_the_message_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(CallerError, match=r"pip install 'noack\[cluster\]'"),
        cluster("tcp://x:1"),
    ):
        pass


def test_a_campaign_without_a_scheduler_does_not_import_dask(
    write: Write, plan: dict[str, Any], tmp_path: Path
) -> None:
    path = write(plan, draws=1)
    code = (
        "import sys; from cosim.cli.command import main; from cosim import cli\n"
        f"sys.argv = ['noack', 'campaign', {str(path)!r}, '--out', {str(tmp_path / 'o')!r},"
        " '--workers', '1', '--json']\n"
        "try:\n    main()\nexcept SystemExit as end:\n    assert end.code == 0, end.code\n"
        "assert 'distributed' not in sys.modules and 'dask' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_a_dead_scheduler_gives_one_line_without_a_hang(
    tmp_path: Path, some: tuple[Campaign, list[Point]]
) -> None:
    plan, points = some
    store = Store(tmp_path / "out", points, plan.draws, plan.chunk)
    own = Cluster(tmp_path)
    told = []

    def progress(done: int, total: int) -> None:
        told.append(done)
        if len(told) == 10:
            own.scheduler.kill()

    try:
        with (
            pytest.raises(PeerError, match=r"the scheduler has ended; \d+ of 240 runs are in"),
            cluster(own.address) as runner,
        ):
            run_campaign(store, runner, progress)
    finally:
        own.close()
