"""noack.follow: the rows of a live run beside it are those of its record."""

import json
import threading
from pathlib import Path

import numpy as np
import pytest

import noack
from noack.core.errors import CallerError


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


@pytest.mark.live
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


def test_a_run_that_is_not_active_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="no run is active"):
        noack.follow(tmp_path, timeout_s=0.0)
