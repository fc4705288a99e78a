"""A live run of the page: what it prints sets its state, and a whole run with a change and a stop."""

import asyncio
import json
from pathlib import Path

import pytest

import noack
from noack_lab.live_run import LiveRun

PROGRESS = {
    "t_s": 1.0,
    "events": 3,
    "deliveries": 1,
    "longest_loss_burst": 2,
    "x_norm": 0.5,
    "late_us": 250.0,
}


def take(run: LiveRun, event: str, **fields: object) -> None:
    run._take(json.dumps({"message": f"it is {event}", "event": event, **fields}))


def test_what_a_live_run_prints_sets_its_state_and_its_lines() -> None:
    run = LiveRun(4.0)
    take(run, "run", directory="runs/a")
    assert (run.state, run.directory) == ("starting", Path("runs/a"))
    take(run, "progress", **PROGRESS)
    take(run, "progress", **PROGRESS | {"t_s": 2.0, "x_norm": None})
    assert (run.state, run.share) == ("running", 0.5)
    shown = run.shown
    assert shown.values("‖x‖ plant").tolist() == [0.5]
    assert shown.verdict[0].text == "running: 2.0 of 4 s"
    assert shown.verdict[1].text == "longest loss burst 2, largest lateness 0.25 ms"
    take(run, "end", directory="runs/a", status=0)
    assert run.is_over
    assert run.lines == ["it is run", "it is end"]


@pytest.mark.parametrize("line", ["compiling ...", "{", "[1]", '{"x": 1}', "7"])
def test_other_output_is_a_line_of_the_log(line: str) -> None:
    run = LiveRun(4.0)
    run._take(line)
    assert (run.state, run.lines) == ("starting", [line])


@pytest.mark.live
def test_a_run_is_changed_stopped_and_recorded(tmp_path: Path) -> None:
    scenario = noack.load("double_integrator", {"horizon_s": 60.0, "ports": None})
    run = LiveRun(scenario.horizon_s)

    async def change_and_stop() -> tuple[str, str]:
        following = asyncio.create_task(run.run(scenario, tmp_path))
        while run.state == "starting":
            await asyncio.sleep(0.1)
        answers = await run.change("network.mansd", 2), await run.change("network.mansd", -1)
        run.stop()
        await following
        return answers

    good, bad = asyncio.run(change_and_stop())
    assert good == ""
    assert "mansd" in bad
    assert run.state == "ended"
    assert run.directory is not None
    recorded = noack.open_run(run.directory)
    assert recorded.reason.startswith("stopped")
    assert recorded.scenario.network.mansd == scenario.network.mansd  # that of the start
    assert len(recorded.summary.loops[0].changes) == 1
