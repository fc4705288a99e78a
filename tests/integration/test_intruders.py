"""Another user attacks the control plane's port of a run of which each process started by hand."""

import contextlib
import json
import os
import signal
import socket
import stat
import subprocess
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import zenoh

from cosim.record.run_record import load_record
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.control_plane import secret_of
from noack.runtime.join_ticket import Ticket, loads
from noack.runtime.zenoh_session import label, session_config
from tests.integration.conftest import PATIENCE_S, Finished, Running, settings, wait_for

GARBAGE_BYTES = 10 * 2**20
HALF_OPEN = 300
ATTACKS = ("flood", "half_open", "garbage", "guess")


class Intruder:
    """Attacks a port in every way that needs no secret, until it is stopped."""

    def __init__(self, ticket: Ticket) -> None:
        self._ticket = ticket
        self._port = int(ticket.endpoint.rpartition(":")[2])
        self._stop = threading.Event()
        self._threads = [
            threading.Thread(target=self._again_and_again, args=(attack,), daemon=True)
            for attack in (getattr(self, name) for name in ATTACKS)
        ]
        self.done: Counter[str] = Counter()
        self.let_in = 0

    @contextlib.contextmanager
    def at_work(self) -> Iterator[None]:
        for thread in self._threads:
            thread.start()
        try:
            yield
        finally:
            self._stop.set()
            for thread in self._threads:
                thread.join(30)

    def _again_and_again(self, attack: Callable[[], None]) -> None:
        while not self._stop.wait(0.1):
            with contextlib.suppress(OSError):  # the run has ended or its queue is full
                attack()
                self.done[attack.__name__] += 1

    def _connect(self) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self._port), timeout=5)

    def flood(self) -> None:
        for _ in range(200):
            self._connect().close()

    def half_open(self) -> None:
        with contextlib.ExitStack() as stack:
            for _ in range(HALF_OPEN):
                stack.enter_context(self._connect())
            self._stop.wait(0.5)

    def garbage(self) -> None:
        """Send random bytes with and without a valid length; zenoh soon closes the connection."""
        left = GARBAGE_BYTES
        while left > 0 and not self._stop.is_set():
            with self._connect() as connection, contextlib.suppress(OSError):
                left -= connection.send(b"\xff\xff" + os.urandom(2**18))
                left -= connection.send(os.urandom(2**18))

    def guess(self) -> None:
        own = secret_of(self._ticket)
        other = secret_of(self._ticket.model_copy(update={"key": bytes(32)}))
        for secret in ({}, own._replace(password="guess")._asdict(), other._asdict()):
            more: dict[str, Any] = {f"transport/auth/usrpwd/{k}": v for k, v in secret.items()}
            more["connect/timeout_ms"] = 200
            config = session_config(self._ticket.endpoint, listen=False, more=more)
            with contextlib.suppress(zenoh.ZError), zenoh.open(config) as session:
                self.let_in += 1
                key = f"noack/{self._ticket.run_id:016x}/stop"
                session.put(key, "intruded", attachment=label(key))


class Attacked:
    """A run started by hand, attacked at least once in each way, and all data visible of it."""

    def __init__(
        self,
        start: Callable[..., Running],
        by_hand: Callable[[str], subprocess.Popen[str]],
        private: Path,
    ) -> None:
        early = [by_hand(role) for role in LOOP_ROLES[:2]]
        recording = start(
            *settings(speed=2.0, horizon_s=400.0), command=("record", "lane_following")
        )
        path = private / "default.json"
        wait_for(path.exists)
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(private.stat().st_mode) == 0o700
        self.ticket = loads(path.read_text())
        processes = early + [by_hand(role) for role in LOOP_ROLES[2:]]
        recording.wait_started()
        self.intruder = Intruder(self.ticket)
        with self.intruder.at_work():
            run_dir = (recording.runs / "latest").resolve()
            self.seen = {
                "command lines and environments": _visible_in_processes(recording, processes),
                "the run directory": _files(run_dir),
                "the private folder": {
                    name: content
                    for name, content in _files(private).items()
                    if name != path.name  # the ticket file contains the key
                },
            }
            wait_for(lambda: all(self.intruder.done[attack] > 0 for attack in ATTACKS))
            recording.process.send_signal(signal.SIGINT)
            self.finished: Finished = recording.finish()
        self.seen["the finished run directory"] = _files(run_dir)
        self.seen["what was printed"] = {"recorder": self.finished.stderr.encode()}
        self.left = _files(private)
        self.ended = {}
        for role, process in zip(LOOP_ROLES, processes, strict=True):
            stdout, stderr = process.communicate(timeout=PATIENCE_S)
            self.seen["what was printed"][role] = (stdout + stderr).encode()
            self.ended[role] = (process.returncode, json.loads(stdout)["ended"])


def _files(folder: Path) -> dict[str, bytes]:
    found = {}
    for path in folder.rglob("*"):
        with contextlib.suppress(FileNotFoundError, IsADirectoryError):
            found[str(path.relative_to(folder))] = path.read_bytes()
    return found


def _visible_in_processes(
    recording: Running, processes: list[subprocess.Popen[str]]
) -> dict[str, bytes]:
    """Return command lines, environments and names of the processes."""
    launcher = psutil.Process(recording.process.pid)
    pids = [launcher.pid, *(child.pid for child in launcher.children(recursive=True))]
    pids += [process.pid for process in processes]
    contents = {}
    for pid in pids:
        for name in ("cmdline", "environ", "comm"):
            contents[f"{pid}/{name}"] = Path(f"/proc/{pid}/{name}").read_bytes()
    return contents


def test_attacks_on_the_control_plane_do_not_affect_a_run(
    start: Callable[..., Running],
    by_hand: Callable[[str], subprocess.Popen[str]],
    tmp_path: Path,
) -> None:
    attacked = Attacked(start, by_hand, tmp_path / f"noack-{os.getuid()}")
    finished = attacked.finished
    assert attacked.intruder.let_in == 0
    assert finished.status == 130, finished.stderr
    assert finished.summary["exit"]["reason"] == "stopped by the user (SIGINT)"
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["unintended_losses"] == 0
    assert finished.summary["replay"]["bit_exact"]
    assert finished.summary["replay"]["complete"]
    assert finished.summary["identity_residual_max"] < 1e-11
    assert set(attacked.ended.values()) == {(1, "stopped by the user (SIGINT)")}
    steps = load_record(finished.run_dir)["plant_step"]
    assert np.array_equal(steps["sequence"], np.arange(len(steps)))
    secrets = {
        "key": attacked.ticket.key,
        "key in words": attacked.ticket.key.hex().encode(),
        "password": secret_of(attacked.ticket).password.encode(),
    }
    own = f"runs/{attacked.ticket.run_id:016x}.json"
    for where, contents in attacked.seen.items():
        for name, content in contents.items():
            for what, secret in secrets.items():
                if what == "password" and name == own:
                    continue  # this user's private file for `noack set`
                assert secret not in content, f"{what} in {where}: {name}"
    assert len(attacked.seen["command lines and environments"]) == 3 * 7  # with the fork server
    assert attacked.left == {}
