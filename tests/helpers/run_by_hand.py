"""A run by hand: each of its processes is started by a command, also on two hosts."""

import json
import os
import signal
import subprocess
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from noack.protocol.roles import LOOP_ROLES
from noack.runtime.run_descriptor import RunDescriptor, parse_descriptor
from tests.helpers.live_runs import EPHEMERAL, Finished, start_commands
from tests.helpers.two_hosts import TwoHosts
from tests.helpers.waiting import PATIENCE_S, wait_for

AWAY = "controller"
"""The process of a run by hand that is on the second host, if there are two."""


class RunByHand:
    """An active run, started one process at a time; ``stack`` ends what remains."""

    def __init__(self, stack: ExitStack, folder: Path, hosts: TwoHosts | None, *arguments: str) -> None:
        self._folder, self.hosts = folder, hosts
        self._begin = stack.enter_context(start_commands())
        credentials = folder / "credentials"
        network = (
            EPHEMERAL if hosts is None
            else ("--listen", hosts.addresses[0][0], "--credentials", str(credentials))
        )  # fmt: skip
        self._recording = self._start(
            0, "record", "lane_following", "--runs", str(folder / "runs"), "--no-report",
            "--set", "certificate.prove=false", *network, *arguments,
        )  # fmt: skip
        self.processes = {
            role: self._start(1, role, "--credentials", str(credentials / role))
            if hosts is not None and role == AWAY
            else self._start(0, role)
            for role in LOOP_ROLES
        }

    def _start(self, host: int, *command: str) -> "subprocess.Popen[str]":
        before = () if self.hosts is None else self.hosts.inside(host)
        return self._begin(*command, "--json", before=before, runtime=self._folder)

    def descriptor(self) -> RunDescriptor:
        """Wait until the run has a descriptor; return it."""
        path = self._folder / f"noack-{os.getuid()}" / "default.json"
        self.wait(path.exists)
        return parse_descriptor(path.read_text())

    def wait(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition; fail if the recording ends before."""
        wait_for(lambda: condition() or self._recording.poll() is not None)
        assert self._recording.poll() is None, self._recording.communicate()

    def stop(self) -> Finished:
        """Stop the run as a user does; return its result, with the recording's exit status."""
        self._recording.send_signal(signal.SIGINT)
        finished = self.finish()
        return replace(finished, status=self._recording.returncode)

    def finish(self) -> Finished:
        """Wait for the end of the run; return its result, with the largest exit status."""
        stdout, stderr = self._recording.communicate(timeout=PATIENCE_S + 600)
        for process in self.processes.values():
            process.communicate(timeout=PATIENCE_S)
        status = max(process.returncode for process in (self._recording, *self.processes.values()))
        run_dir = (self._folder / "runs" / "latest").resolve()
        return Finished(status, json.loads(stdout), stderr, run_dir)
