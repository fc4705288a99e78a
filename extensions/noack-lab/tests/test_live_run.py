"""A live run of the page: what it prints sets its state, and a whole run with a change and a stop."""

import asyncio
import json
from pathlib import Path

import numpy as np
import pytest

import noack
from noack_lab.chart import Drawn, chart_options, height_px
from noack_lab.live_run import LiveRun
from noack_lab.results import LIVE, NORM, ShownRun

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
    assert shown.values("norm of the state", "‖x‖ plant").tolist() == [0.5]
    assert {float(curve.t_s[0]) for curve in shown.curves} == {0.0}
    run.norm_at_start = 3.0
    assert run.shown.values("norm of the state", "‖x‖ plant").tolist() == [3.0, 0.5]
    assert shown.verdict[0].text == "running: 2.0 of 4 s"
    assert shown.verdict[1].text == "longest loss burst 2, largest lateness 0.25 ms"
    take(run, "end", directory="runs/a", status=0)
    assert run.is_over
    assert run.lines == ["it is run", "it is end"]


def test_each_panel_of_the_chart_has_the_time_and_room_for_its_legend() -> None:
    """On a phone the legend wraps; a page shows the first panels without scrolling."""
    run = LiveRun(4.0)
    take(run, "progress", **PROGRESS)
    options = chart_options(Drawn(run.shown, ""))
    assert all(axis["axisLabel"].get("show", True) and axis["min"] == 0 for axis in options["xAxis"])
    assert {legend.get("type", "plain") for legend in options["legend"]} == {"plain"}
    for legend, grid in zip(options["legend"], options["grid"], strict=True):
        widths = [50 + 7.5 * len(name) for name in legend["data"]]
        lines = sum(widths) / 300
        assert grid["top"] - legend["top"] >= 22 * lines
    assert height_px(options) > options["grid"][-1]["top"] + options["grid"][-1]["height"]
    sent, received = (run.shown.curves[i].style.width for i in (1, 2))
    assert sent > 2 * received  # both are visible where they coincide


@pytest.mark.parametrize(("width_px", "lines"), [(366, 4), (700, 2)])
def test_a_legend_has_as_many_lines_as_the_width_of_the_chart_needs(width_px: int, lines: int) -> None:
    names = [
        "‖x‖ plant",
        "certified for the scenario's plant",
        "certified for every plant",
        "Theorem 2 (eq:normXt)",
    ]
    t_s = np.arange(2.0)
    curves = [noack.Curve(NORM, name, "", t_s, t_s + 1, noack.CurveStyle((0, 0, 0))) for name in names]
    options = chart_options(Drawn(ShownRun(LIVE, curves), "", width_px=width_px))
    room = options["grid"][0]["top"] - options["legend"][0]["top"]
    assert 23 * lines <= room < 23 * (lines + 1)  # a line of 13 pixels, and a gap of 10


@pytest.mark.parametrize(("t_s", "end_s"), [(0.1, 5.0), (5.0, 5.0), (5.1, 10.0), (12.0, 20.0), (70.0, 80.0)])
def test_the_axis_of_a_live_run_rarely_changes_and_ends_at_the_horizon(t_s: float, end_s: float) -> None:
    run = LiveRun(80.0)
    take(run, "progress", **PROGRESS | {"t_s": t_s})
    assert chart_options(Drawn(run.shown, ""))["xAxis"][0]["max"] == end_s
    take(run, "end", directory="runs/a", status=0, reason="horizon")
    assert run.shown.verdict[0].text == "completed 80 s"


@pytest.mark.parametrize("line", ["compiling ...", "{", "[1]", '{"x": 1}', "7"])
def test_other_output_is_a_line_of_the_log(line: str) -> None:
    run = LiveRun(4.0)
    run._take(line)
    assert (run.state, run.lines) == ("starting", [line])


@pytest.mark.live
def test_a_run_is_changed_stopped_and_recorded(tmp_path: Path) -> None:
    scenario = noack.load("double_integrator", {"horizon_s": 60.0, "ports": None, "certificate.prove": False})
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
