"""A live run that the page has started, as a process of its own, which never disturbs the loop.

:class:`LiveRun` is the page's side: the process, its progress, what it has reported. Run as a
program, this module is the other side: it reads the scenario's text from standard input, until its
end, and writes one JSON object per line on standard output: an event with its fields.
"""

import asyncio
import json
import os
import re
import signal
import sys
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cosim.interactive.scenario_draft import Draft
from cosim.live.launcher import launch
from cosim.live.monitoring.run_watcher import Watcher
from cosim.output.run_verdict import Tone, VerdictLine
from cosim.output.viewer.rerun_program import is_installed
from netem.shell import process
from noack.core.errors import ExitStatus, NoackError
from noack.core.system_processes import python_command
from noack.protocol.roles import LOOP_ROLES
from noack.runtime.command_line import StopRequestError
from noack.runtime.control_messages import RunProgress, parse_message

if TYPE_CHECKING:
    from cosim.interactive.exploration import Exploration

_WEB_ADDRESS = re.compile(r"http://\S+")
MOST_LINES = 200
"""Lines of the log that are kept."""
_STOP_S = 20.0
"""Time limit for a loop that is asked to end."""
_DISPLAY_VARIABLES = ("DISPLAY", "WAYLAND_DISPLAY")
"""Removed from the environment: the viewer is shown in the page, not in a window."""


@dataclass
class LiveRun:
    """The state of a live run; :meth:`follow` keeps it current until the run has ended."""

    horizon_s: float
    state: Literal["starting", "running", "finalising", "ended", "failed"] = "starting"
    run_dir: Path | None = None
    viewer: str | None = None
    """Address of the rerun viewer."""
    progress: RunProgress | None = None
    lines: list[str] = field(default_factory=list)
    """What happened, the newest line last."""
    first_line: int = 0
    """Number of lines that happened before these."""
    verdict: list[VerdictLine] = field(default_factory=list)
    """The verdict at the end; empty before."""
    ok: bool | None = None
    exploration: "Exploration | None" = None
    """What was recorded when a page last asked for it."""
    watched: bool = False
    """Whether a page has shown the run since then."""
    version: int = 0
    """Grows with each change."""
    _process: asyncio.subprocess.Process | None = None

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return self.state in ("ended", "failed")

    async def start(self, text: str, folder: Path, runs: Path) -> None:
        """Start the run of a scenario's text; relative file names in it are relative to ``folder``.

        The text goes through a pipe: another user may be able to replace a file.
        """
        environment = {key: value for key, value in os.environ.items() if key not in _DISPLAY_VARIABLES}
        self._process = await asyncio.create_subprocess_exec(
            *python_command("-m", "cosim.lab.live_run", folder.absolute(), runs.absolute()),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            stdin=asyncio.subprocess.PIPE,
            env=environment,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        self._process.stdin.write(text.encode())
        self._process.stdin.close()  # after the text; a process that has ended needs none

    async def follow(self) -> None:
        """Read the reports of the run until it has ended."""
        assert self._process is not None
        assert self._process.stdout is not None
        async for line in self._process.stdout:
            self._handle_line(line.decode(errors="replace").strip())
            self.version += 1
        status = await self._process.wait()
        if not self.is_over:
            self.state, self.ok = "failed", False
            self._add_line(f"the run ended with status {status}")
        self.version += 1

    def stop(self) -> None:
        """Ask the run to end; what was recorded is kept."""
        if self._process is not None and self._process.returncode is None:
            with suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)

    async def end(self) -> None:
        """End the run and wait for it.

        A loop that does not end in time is killed. A run that is being checked ends by itself.
        """
        self.stop()
        if self._process is not None and self._process.returncode is None:
            try:
                await asyncio.wait_for(self._process.wait(), _STOP_S)
            except TimeoutError:
                if self.state != "finalising":
                    self._process.kill()
                await self._process.wait()

    def kill(self, role: str) -> bool:
        """Kill a process of the loop, to see what happens; return whether there was one."""
        if self._process is None or role not in LOOP_ROLES:
            return False
        for pid in _descendants(self._process.pid):
            if _title(pid) == f"noack {role}":
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    return True
        return False

    def _handle_line(self, line: str) -> None:
        try:
            message = json.loads(line)
            event = message.pop("event")
        except (ValueError, AttributeError, KeyError, TypeError):
            self._add_line(line)  # a message of a library, or of the compiler
            return
        match event:
            case "started":
                self.state, self.run_dir = "running", Path(message["run_dir"])
                self._add_line("all processes run")
            case "progress":
                self._handle_progress(parse_message(RunProgress, line))
            case "finalising":
                self.state = "finalising"
                self._add_line(f"ended: {message['reason']}; replaying it and checking its claims")
            case "ended":
                self.state, self.ok = "ended", message["ok"]
                self.run_dir = Path(message["run_dir"])
                self.verdict = [VerdictLine(text, Tone(tone)) for text, tone in message["verdict"]]
                self._add_line(f"recorded in {self.run_dir}")
            case _:
                self.state, self.ok = "failed", False
                self._add_line(message.get("text", line))

    def _handle_progress(self, report: RunProgress) -> None:
        before = self.progress
        for text in report.warnings[len(before.warnings) if before else 0 :]:
            self._add_line(text)
        for text in report.changes[len(before.changes) if before else 0 :]:
            self._add_line(f"changed: {text}")
        if self.viewer is None and (match := _WEB_ADDRESS.search(report.live or "")):
            self.viewer = match[0]
        self.progress = report

    def _add_line(self, line: str) -> None:
        if line:
            self.lines.append(line)
            more = max(len(self.lines) - MOST_LINES, 0)
            del self.lines[:more]
            self.first_line += more


def _descendants(pid: int) -> list[int]:
    """Return the processes below a process."""
    own_children = sorted(process.children(pid))
    return own_children + [below for child in own_children for below in _descendants(child)]


def _title(pid: int) -> str:
    with suppress(OSError):
        return Path("/proc", str(pid), "cmdline").read_bytes().replace(b"\0", b" ").decode().strip()
    return ""


def main() -> int:
    """Run a scenario; the arguments are the folder of the files that it names, and of the runs."""
    folder, runs = map(Path, sys.argv[1:3])
    watcher = Watcher(
        started=lambda run_dir: _report("started", run_dir=str(run_dir)),
        progress=lambda report: _report("progress", **report.fields()),
    )
    try:
        draft = Draft("scenario", folder, "", sys.stdin.buffer.read().decode())
        ending = launch(draft.scenario, runs, live=is_installed(), watcher=watcher)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a stop now must not cost the summary
        _report("finalising", reason=ending.reason)
        from cosim.live.finalize import finalize  # not earlier: it would take time from the loop
        from cosim.output.run_verdict import verdict

        outcome = finalize(ending, report=False)
    except (NoackError, StopRequestError) as error:
        _report("error", text=str(error))
        return error.exit_status
    _report(
        "ended",
        run_dir=str(outcome.run_dir),
        reason=outcome.reason,
        ok=outcome.status is ExitStatus.OK,
        verdict=verdict(outcome.summary),
    )
    return outcome.status


def _report(event: str, **fields: object) -> None:
    with suppress(BrokenPipeError):  # the page has ended; the run is recorded all the same
        print(json.dumps({"event": event, **fields}), flush=True)


if __name__ == "__main__":
    sys.exit(main())
