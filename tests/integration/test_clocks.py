"""Runs whose processes have different monotonic clocks, in time namespaces: offsets are known."""

import json
import os
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.record.run_record import RunRecord, load_record
from noack.core.clock import NS_PER_S
from noack.protocol.record_tables import CLOCK_TABLES, LOST_NS, OWNER
from noack.protocol.topology import LOOP_ROLES
from tests.integration import conftest as live

HORIZON_S = 3.0
ROOMY = "clocks.largest_error_us=1000000"
"""A busy machine gives wide bounds."""


def _another_clock(ahead_s: int) -> list[str]:
    return ["unshare", "--time", f"--monotonic={ahead_s}", "--fork", "--kill-child"]


@pytest.fixture(scope="module", autouse=True)
def _may_set_clocks() -> None:
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("only root can make time namespaces")
    if subprocess.run([*_another_clock(1), "true"], capture_output=True, check=False).returncode:
        pytest.skip("no time namespaces here")


class Forwarder:
    """Passes the datagrams of one client to a port and back, while it is open."""

    def __init__(self, port: int) -> None:
        self._to = ("127.0.0.1", port)
        self._inside, self._outside = (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)
        )
        for one in (self._inside, self._outside):
            one.bind(("127.0.0.1", 0))
        self.port = int(self._inside.getsockname()[1])
        self._client: tuple[str, int] | None = None
        self.is_open, self._stop = True, False

    def work(self) -> None:
        while not self._stop:
            for one in select.select([self._inside, self._outside], (), (), 0.05)[0]:
                data, source = one.recvfrom(2048)
                if one is self._inside:
                    self._client = source
                target = self._to if one is self._inside else self._client
                if self.is_open and target is not None:
                    (self._outside if one is self._inside else self._inside).sendto(data, target)

    @contextmanager
    def working(self) -> Iterator["Forwarder"]:
        thread = threading.Thread(target=self.work)
        thread.start()
        try:
            yield self
        finally:
            self._stop = True
            thread.join()
            self._inside.close()
            self._outside.close()


class Run:
    """A run whose processes are started by hand, some of them with another clock."""

    def __init__(self, stack: ExitStack, folder: Path, *settings: str) -> None:
        self._stack, self._folder = stack, folder
        self._start = partial(stack.enter_context(live.starting()), cwd=folder, runtime=folder)
        self.recording = self._start(
            "record", "lane_following", "--listen", "127.0.0.1", "--json", *live.BARE,
            *live.AT_RATE, *live.settings(horizon_s=HORIZON_S), *settings,
        )  # fmt: skip
        self.invitation = folder / "invitation.json"
        live.wait_for(lambda: self.invitation.exists() or self.recording.poll() is not None)
        assert self.recording.poll() is None, self.recording.communicate()

    def join(self, role: str, ahead_s: int = 0) -> subprocess.Popen[str]:
        if not ahead_s:
            return self._start(role, "--json")
        invited = ("--invitation", self.invitation, "--json")
        return self._start(role, *invited, before=_another_clock(ahead_s))

    def forwarder(self) -> Forwarder:
        """Change the invitation, so that requests for the time pass a forwarder."""
        content = json.loads(self.invitation.read_text())
        found = Forwarder(content["time_reference"][1])
        self._stack.enter_context(found.working())
        content["time_reference"][1] = found.port
        self.invitation.write_text(json.dumps(content))
        return found

    def finished(self) -> tuple[dict[str, Any], RunRecord]:
        """Return the summary of the loop, and the record."""
        stdout, stderr = live.ended(self.recording)
        assert self.recording.returncode == 0, stderr
        (loop,) = json.loads(stdout)["loops"]
        return loop, load_record((self._folder / "runs" / "latest").resolve())


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as entered:
        yield entered


def test_processes_with_other_clocks_carry_a_run(stack: ExitStack, tmp_path: Path) -> None:
    """In test_hosts.py the other two processes are ahead."""
    away, ahead_s = ("plant", "sensor"), -1
    run = Run(stack, tmp_path, "--set", ROOMY)
    processes = [run.join(role, ahead_s if role in away else 0) for role in LOOP_ROLES]
    for process in processes:
        _, stderr = live.ended(process)
        assert process.returncode == 0, stderr
    loop, record = run.finished()
    live.assert_complete(loop)
    assert len(record["plant_step"]) == HORIZON_S * live.RATE_HZ + 1
    for table in ("plant_step", "controller_step"):  # nobody begins before the common epoch
        assert (record[table]["now_ns"] >= record[table]["t_ns"]).all()
    for table in CLOCK_TABLES:
        rows, true_ns = record[table], -ahead_s * NS_PER_S * (OWNER[table] in away)
        assert len(rows) > 0
        known = rows[rows["error_ns"] != LOST_NS]
        assert (np.abs(known["offset_ns"] - true_ns) <= known["error_ns"]).all()
        assert (np.diff(rows["now_ns"]) >= 0).all()
        assert (known["error_ns"] > 0).all() == (OWNER[table] in away)
    assert 0 < loop["conditions"]["clock_error_s"] < 1


def test_a_lost_bound_voids_all_claims_within_a_second(stack: ExitStack, tmp_path: Path) -> None:
    # A busy machine may see late that the run has begun.
    run = Run(stack, tmp_path, "--set", ROOMY, *live.settings(horizon_s=8.0))
    way = run.forwarder()
    for role in LOOP_ROLES:
        run.join(role, 1 if role == "controller" else 0)
    spooled = tmp_path / "runs" / "latest" / "spool" / "controller_clock.recorder"
    live.wait_for(lambda: spooled.exists() and spooled.stat().st_size > 0)
    way.is_open = False
    loop, record = run.finished()
    rows = record["controller_clock"]
    answered_ns = int(rows["now_ns"][np.searchsorted(rows["sequence"], rows["sequence"][-1])])
    lost = rows[rows["error_ns"] == LOST_NS]
    assert len(lost) > 0
    since_s = max(lost["t_ns"].min(), 0) / NS_PER_S
    assert since_s <= answered_ns / NS_PER_S + 1
    claims = loop["claims"]
    assert "held" not in {claim["verdict"] for claim in claims}
    why = "the bound of the error of controller's clock was lost"
    void = [claim for claim in claims if why in claim["why"]]
    assert {claim["source"] for claim in void} >= {"(I1)"}
    (void_s,) = {claim["since_s"] for claim in void if claim["source"] == "(I1)"}
    assert void_s == pytest.approx(since_s, abs=1e-9)
    assert "controller clock lost" in {one["cause"] for one in loop["assumption_violations"]}
    texts = [one["text"] for one in record.notices if one["process"] == "controller"]
    assert any(
        text.startswith("the bound of its clock's error is lost: no answer") for text in texts
    )


def test_without_a_reference_a_process_with_another_clock_does_not_join(
    stack: ExitStack, tmp_path: Path
) -> None:
    run = Run(stack, tmp_path)
    content = json.loads(run.invitation.read_text())
    run.invitation.write_text(json.dumps(content | {"time_reference": None}))
    process = run.join("controller", 1)
    _, stderr = live.ended(process)
    assert process.returncode == 1
    joining, refused = stderr.splitlines()
    assert joining.startswith("noack controller: joining run")
    assert refused.startswith(
        "noack controller: this process and the run's coordinator have differ"
    )
