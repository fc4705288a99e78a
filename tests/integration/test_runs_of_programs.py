"""Live runs that a program starts, follows and interrupts."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import noack
from cosim.live.finalize import reopen
from cosim.live.launcher import launch
from netem.core import command_line
from netem.core.command_line import StopRequestError
from netem.core.errors import CallerError, ExitStatus
from tests.helpers.live_runs import WITHOUT_VIEWER

pytestmark = pytest.mark.live


class Follower(noack.RunObserver):
    """Collects the steps of the plant and the names of loops, in a thread of its own."""

    def __init__(self) -> None:
        self.steps: dict[int, bytes] = {}
        self.notices: list[tuple[str, str, str]] = []
        self.refusal = ""
        self.loops: set[tuple[str, tuple[str, ...]]] = set()
        self._thread = threading.Thread(target=self._follow)

    def started(self, run_dir: Path) -> None:
        self._directory = run_dir
        self._thread.start()

    def _follow(self) -> None:
        run = noack.follow(self._directory)
        try:
            run.rows("plant_steps")
        except CallerError as error:
            self.refusal = str(error)
        for table, loop, rows in run.rows("plant_step", "notices"):
            if table == "notices":
                self.notices += [(row["level"], row["text"], row["process"]) for row in rows]
                continue
            assert table == "plant_step"
            self.loops.add((loop.name, loop.states))
            self.steps |= {int(row["t_ns"]): row["x"].tobytes() for row in rows}

    def wait(self) -> None:
        self._thread.join()


@pytest.mark.usefixtures("no_report", "no_recording")
def test_who_follows_a_run_receives_rows_of_its_record() -> None:
    follower = Follower()
    # Without the guarantee, most bursts of losses violate an assumption: a notice of the controller each.
    lossy = {"network.mansd": 2, "network.enforce_mansd": False, "network.loss.probability": 0.95}
    fast = {"trigger.beta": 1e-6, "trigger.floor": 1e-6}
    scenario = noack.load("double_integrator", {"horizon_s": 2.0, "ports": {}, **lossy, **fast})
    run = noack.run(scenario, observers=[follower])
    follower.wait()  # it ends with the run
    steps = run.table("plant_step")
    x = np.column_stack([steps["x_1"].to_numpy(), steps["x_2"].to_numpy()])
    recorded = dict(zip(steps["t_ns"].to_pylist(), map(np.ndarray.tobytes, x), strict=True))
    assert follower.steps
    assert follower.steps.items() <= recorded.items()
    assert {name for name, _ in follower.loops} == {"double_integrator"}
    assert follower.refusal == "plant_steps: a run has no such table; did you mean plant_step?"
    lines = map(json.loads, (run.directory / "record/notices.jsonl").read_text().splitlines())
    recorded_lines = {(line["level"], line["text"], line["process"]) for line in lines}
    assert follower.notices
    assert recorded_lines.issuperset(follower.notices)


def test_an_interrupted_live_run_is_returned() -> None:
    program = (
        "import noack\n"
        "scenario = noack.load('double_integrator', {'horizon_s': 10.0, 'certificate.prove': False})\n"
        "run = noack.run(scenario, progress=True)\n"
        "print(run.ok, run.reason, run.summary.reached_s > 0)"
    )
    with subprocess.Popen(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        # A terminal: to a pipe progress is printed after ten seconds.
        env=os.environ | WITHOUT_VIEWER | {"FORCE_COLOR": "1", "TERM": "dumb"},
    ) as process:  # fmt: skip
        assert process.stderr is not None
        assert any("/10 s" in line for line in process.stderr)
        process.send_signal(signal.SIGINT)
        stdout, _ = process.communicate(timeout=100)
    assert stdout.split("\n")[0] == "False stopped by the user (SIGINT) True"
    assert process.returncode == 0


class Interrupted(noack.RunObserver):
    """Interrupts the run at its start, and again while it stops."""

    def started(self, run_dir: Path) -> None:
        signal.raise_signal(signal.SIGINT)

    def stopping(self, reason: str) -> None:
        signal.raise_signal(signal.SIGINT)


def test_after_a_second_signal_the_record_is_incomplete_and_can_be_completed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_line, "_ECHO_NS", -1)  # the second one may follow at once

    with pytest.raises(StopRequestError, match=r"stopped by the user \(SIGINT\)") as stopped:
        launch(
            noack.load("double_integrator"),
            tmp_path,
            observers=[Interrupted()],
        )
    (run_dir,) = (path for path in tmp_path.iterdir() if not path.is_symlink())
    how = f"the run's record is incomplete: `noack summary {run_dir}` completes it"
    assert (stopped.value.exit_status, stopped.value.__notes__) == (ExitStatus.INTERRUPTED, [how])
    assert reopen(run_dir, view=False).status == ExitStatus.INTERRUPTED
