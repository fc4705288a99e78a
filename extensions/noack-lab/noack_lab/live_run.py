"""A live run that the page has started: the command ``noack run``, which never disturbs the loop.

Its standard error has one JSON object per line: that the run is prepared, its progress once a
second, warnings, its end.
"""

import asyncio
import json
import math
import os
import signal
import subprocess
import sysconfig
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomlkit

import noack
from noack_lab.results import LIVE, NORM, ShownRun, VerdictText

MOST_LINES = 200
"""Lines of the log that are kept."""
_STOP_S = 20.0
"""Time limit for a loop that is asked to end."""
_GREY, _BLUE, _ORANGE = (155, 142, 159), (51, 93, 213), (255, 86, 10)
COUNTS = "transmissions"


def noack_program() -> str:
    """Return the path of the command ``noack`` of this Python."""
    return str(Path(sysconfig.get_path("scripts")) / "noack")


class LiveRun:
    """The state of a live run; :meth:`follow` keeps it current until the run has ended."""

    def __init__(self, horizon_s: float) -> None:
        self.horizon_s = horizon_s
        self.state: Literal["starting", "running", "ended", "failed"] = "starting"
        self.directory: Path | None = None
        self.reports: list[dict[str, Any]] = []
        """Reports of the progress."""
        self.lines: list[str] = []
        """What happened, the newest line last."""
        self.norm_at_start: float | None = None
        """‖x‖ at t = 0; None if the scenario draws it, or has several loops."""
        self._is_complete = False
        self.version = 0
        """Grows with each change."""
        self._process: asyncio.subprocess.Process | None = None

    @property
    def is_over(self) -> bool:
        """Whether it has ended."""
        return self.state in ("ended", "failed")

    @property
    def share(self) -> float:
        """The simulated share of the horizon."""
        return min((self.reports[-1]["t_s"] if self.reports else 0.0) / self.horizon_s, 1.0)

    @property
    def shown(self) -> ShownRun:
        """What is known so far: ‖x‖ and the counts of transmissions over time, from t = 0 on."""
        start = {"t_s": 0.0, "x_norm": self.norm_at_start, "events": 0, "deliveries": 0}
        reports = [start, *self.reports] if self.reports else []
        t_s, norm, sent, received = (
            np.array([report[key] if report[key] is not None else np.nan for report in reports])
            for key in ("t_s", "x_norm", "events", "deliveries")
        )
        curves = [
            noack.Curve(NORM, "‖x‖ plant", "", t_s, norm, noack.CurveStyle(_GREY, 2.4)),
            # Wider than the curve that is drawn over it: both are visible where they coincide.
            noack.Curve(COUNTS, "sent", "", t_s, sent, noack.CurveStyle(_BLUE, 4.0, is_held=True)),
            noack.Curve(COUNTS, "received", "", t_s, received, noack.CurveStyle(_ORANGE, 1.6, is_held=True)),
        ]
        return ShownRun(
            LIVE, curves, self._verdict(), end_s=self._axis_end_s(float(t_s[-1])) if len(t_s) else None
        )

    def _axis_end_s(self, t_s: float) -> float:
        """Return the end of an axis that rarely changes while the run goes on, such as 5, 10, 20, 50 s."""
        decade = 10.0 ** math.floor(math.log10(max(t_s, 5.0)))
        end_s = next(factor * decade for factor in (1, 2, 5, 10) if factor * decade >= max(t_s, 5.0))
        return min(end_s, self.horizon_s)

    def _verdict(self) -> list[VerdictText]:
        if not self.reports:
            return [VerdictText(self.state)]
        report = self.reports[-1]
        late_ms = report["late_us"] / 1000
        progress = f"{self.state}: {report['t_s']:.1f} of {self.horizon_s:g} s"
        return [
            VerdictText(f"completed {self.horizon_s:g} s" if self._is_complete else progress),
            VerdictText(
                f"longest loss burst {report['longest_loss_burst']}, largest lateness {late_ms:.3g} ms"
            ),
            VerdictText(f"{report['events']} transmissions, {report['deliveries']} delivered"),
        ]

    async def run(self, scenario: noack.Scenario, runs: Path) -> None:
        """Run a scenario from start to end.

        Its file is in a folder of this user, where no other can replace it.
        """
        x0 = scenario.plant.initial_state if scenario.loops is None else None
        if x0 is not None and scenario.plant.initial_state_halfwidth is None:
            self.norm_at_start = float(np.linalg.norm(x0))
        with tempfile.TemporaryDirectory(prefix="noack-lab-") as folder:
            path = Path(folder) / f"{scenario.name}.toml"
            path.write_text(tomlkit.dumps(scenario.model_dump(mode="json", exclude_none=True)), "utf-8")
            words = ["run", str(path), "--runs", str(runs.absolute()), "--log-format", "jsonl", "--no-report"]
            self._process = await asyncio.create_subprocess_exec(
                noack_program(),
                *words,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
                start_new_session=True,
            )
            await self._follow(self._process)

    async def _follow(self, process: asyncio.subprocess.Process) -> None:
        assert process.stderr is not None
        async for line in process.stderr:
            self._take(line.decode(errors="replace").strip())
            self.version += 1
        status = await process.wait()
        if not self.is_over:
            self.state = "failed"
            self._add_line(f"the run ended with status {status}")
        self.version += 1

    def stop(self) -> None:
        """Ask the run to end; what was recorded is kept."""
        if self._process is not None and self._process.returncode is None:
            with suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGINT)

    async def end(self) -> None:
        """End the run and wait for it; a run that does not end in time is killed."""
        self.stop()
        if self._process is not None and self._process.returncode is None:
            try:
                await asyncio.wait_for(self._process.wait(), _STOP_S)
            except TimeoutError:
                with suppress(ProcessLookupError):
                    os.killpg(self._process.pid, signal.SIGKILL)

    async def change(self, key: str, value: float) -> str:
        """Change a setting of the running loop; return why that failed, or an empty text."""
        if self.state != "running" or self.directory is None:
            return ""
        process = await asyncio.create_subprocess_exec(
            noack_program(), "set", key, str(value), "--run", str(self.directory),
            stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=asyncio.subprocess.PIPE,
        )  # fmt: skip
        _, errors = await process.communicate()
        return errors.decode(errors="replace").strip() if process.returncode else ""

    def _take(self, line: str) -> None:
        """Take a line that the run has printed."""
        try:
            message = json.loads(line)
            event, text = message.get("event"), str(message["message"])
        except (ValueError, AttributeError, KeyError, TypeError):
            self._add_line(line)  # a message of a library
            return
        match event:
            case "run":
                self.directory = Path(message["directory"])
                self._add_line(text)
            case "progress":
                self.state = "running"
                self.reports.append(message)
            case "end":
                self.state = "ended"
                self._is_complete = message.get("reason") == "horizon"
                self.directory = Path(message["directory"])
                self._add_line(text)
            case _:
                self._add_line(text)

    def _add_line(self, line: str) -> None:
        if line:
            self.lines = [*self.lines[1 - MOST_LINES :], line]
