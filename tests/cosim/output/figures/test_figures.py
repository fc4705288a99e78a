"""Figures: every curve is named, the same bytes each time, as wide as a paper wants."""

import re
from pathlib import Path
from typing import Any

import matplotlib as mpl
import matplotlib.image
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb

import noack
from cosim.analysis.summary.quantiles import QuantileSketch
from cosim.output.curves import DASHED, ERRORS, INPUT, STATE_NORM, Curve, CurveStyle, state_curves
from cosim.output.figures import axes_parts, palette
from cosim.output.figures.figure_files import save_figure, save_figures
from cosim.output.figures.figure_format import PHONE_IN, SCREEN_IN, requested_files
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.output.figures.run_figures import Transmissions, draw_norms, draw_states, run_curves, run_figures
from cosim.output.figures.timing_figures import later_than
from netem.core.errors import CallerError
from tests.cosim.output.conftest import CASES

T_S = np.arange(1.0, 5.0)


def norms(*curves: Curve) -> PageFigure:
    """A figure of norms on a logarithmic axis."""
    return one_panel("norms", 2.0, lambda axes: draw_norms(axes, "norms", curves))


def curve(t_s: np.ndarray, y: np.ndarray, name: str = "measured") -> Curve:
    return Curve(ERRORS, name, "", t_s, y, CurveStyle(palette.SENSOR))


def described(case: str) -> dict[str, PageFigure]:
    """Every figure of a record."""
    envelopes: list[Any] = [
        ("certified", "e_c", T_S, 5 * np.exp(-T_S), "certified"),
        ("certified for every plant of the uncertainty box", "x", T_S, T_S, "certified"),
        ("printed", "inter_event", T_S, T_S, "printed"),
    ]
    figures = run_figures(CASES[case](), envelopes, timed=True)
    return {name: describe() for name, describe in figures.items()}


LEGENDS = {
    "errors": ["controller", "sensor", "threshold", "certified"],
    "state-norm": ["plant", "certified for every plant of the uncertainty box"],
    "inter-event": ["printed"],
    "lateness": ["plant", "sensor", "netem", "controller", "one period"],
}
"""How the labels of a figure's first legend end."""


@pytest.mark.parametrize("case", CASES)
def test_every_figure_is_drawn_with_its_curves_in_the_legend(case: str, tmp_path: Path) -> None:
    """Warnings are errors here: no log of zero, no limits that coincide."""
    for name, figure in described(case).items():
        shown = labels(figure.draw().axes[0])
        expected = LEGENDS.get(name, shown)
        assert len(shown) == len(expected), name
        assert all(map(str.endswith, shown, expected)), (name, shown)
        if case == "diverged":
            save_figure(figure, tmp_path / f"{name}.png")
            assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_a_figure_without_data_states_that() -> None:
    for name, describe in run_figures(CASES["empty"](), timed=True).items():
        for axes in describe().draw().axes:
            assert {"no data", "no loss"} & {text.get_text() for text in axes.texts}, name


def test_equal_bounds_of_intervals_of_which_there_are_none_are_drawn() -> None:
    """A line across a logarithmic axis is rounded: limits around it alone would coincide."""
    equal = [("certified", "inter_event", T_S, np.full(len(T_S), 0.01), "certified")] * 2
    figure = run_figures(CASES["empty"](), equal, timed=False)["inter-event"]()
    assert figure.draw(3.4).axes[0].get_ylim() == pytest.approx((0.01 / 1.1, 0.011))


def labels(axes: Axes) -> list[str]:
    legend = axes.get_legend()
    return [] if legend is None else [text.get_text() for text in legend.get_texts()]


def test_intervals_and_fates_are_drawn_at_their_times() -> None:
    sent_s = np.array([0.0, 1.0, 1.5, 3.0, 3.25])
    lost, x = np.array([False, True, False, True, False]), np.zeros((10, 1))
    t_s = np.linspace(0, 4, 10)
    states = state_curves(["x"], t_s, x, x, x, x)
    transmissions = Transmissions(sent_s, lost, sent_s[~lost], np.array([True, False, True]))
    figure = PageFigure(
        name="states",
        draw_panels=lambda figure: draw_states(figure, "one draw", t_s, states, transmissions),
    )
    _, above, below = figure.draw().axes
    assert labels(above) == ["sent", "sent, lost"]
    assert labels(below) == ["received", "received, forced", "lost"]
    points = {
        line.get_marker(): dict(np.column_stack(line.get_data()).tolist())
        for axes in (above, below)
        for line in axes.lines
        if line.get_marker() != "None"
    }
    assert points["D"] == {3.25: 1.75}  # the first event, at 0, has no interval
    assert points["o"] == {1.5: 1.5}  # the received update that was not forced
    sent, lost_ones = above.lines[1], above.lines[3]
    assert np.asarray(sent.get_xdata()).tolist() == [1.5, 3.25]
    assert np.asarray(lost_ones.get_ydata()).tolist() == [1.0, 1.5]


def test_the_distribution_of_lateness_is_exact_at_its_ends() -> None:
    late_us = np.random.default_rng(1).lognormal(3, 1, 5000)
    found_us, share = later_than(QuantileSketch.of([late_us]))
    assert (found_us[0], found_us[-1]) == (late_us.min(), late_us.max())
    assert (share[0], share[-1]) == (1, 1 / 5000)
    assert np.array_equal(share, [(late_us >= value).mean() for value in found_us])
    assert len(share) < 300


@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_the_same_figure_gives_the_same_bytes(tmp_path: Path, ending: str) -> None:
    path, contents = tmp_path / f"figure.{ending}", set()
    settings: tuple[Any, ...] = ({}, {"lines.linewidth": 9, "axes.titlepad": 40, "svg.hashsalt": "other"})
    for user_settings in settings:
        with mpl.rc_context(user_settings):
            save_figure(norms(curve(T_S, T_S)), path)
        contents.add(path.read_bytes())
    (content,) = contents
    for trace in (b"http://purl", b"matplotlib.org", b"dc:date", b"Software"):
        assert trace not in content


def test_the_figures_of_a_report_are_written_as_wide_as_a_paper_wants(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("double_integrator", {"horizon_s": 0.3}))
    names = {path.stem for path in run.save_figures("svg")}
    assert names == {"errors", "input", "inter-event", "losses", "outputs", "state-norm", "states"}
    assert [path.name for path in run.save_figures("png", figure="losses")] == ["losses.png"]
    with pytest.raises(CallerError, match='"loss": no such figure of this run; it has outputs, states, '):
        run.save_figures("png", figure="loss")
    with pytest.raises(CallerError, match="format eps: 'eps' is not one of 'svg', 'png', 'pdf'"):
        run.save_figures("eps")
    with pytest.raises(CallerError, match=r"figure\.eps: a figure is saved as \.svg"):
        save_figure(norms(curve(T_S, T_S)), tmp_path / "figure.eps")
    for width, points in ((None, 252.0), ("page", 515.52), (5, 360.0)):
        files = requested_files("pdf", width)
        (path,) = save_figures([norms(curve(T_S, T_S))], tmp_path / "page.html", files)
        content = path.read_bytes()
        box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ", content)
        assert box is not None
        assert float(box[1]) == pytest.approx(points, abs=0.01)
        assert b"STIXGeneral" in content
        assert b"/Type3" not in content.replace(b" ", b"")  # refused by publishers
    states = run.directory / "report-figures/states.svg"
    assert states.read_text().count('width="720pt"') == 1


def test_many_dots_at_one_height_keep_their_colour(tmp_path: Path) -> None:
    """Each event of a periodic sensor has the same interval: the dots overlap and form a line."""
    trigger = {"policy": "periodic", "period_s": 0.02}
    run = noack.simulate(noack.load("double_integrator", {"horizon_s": 6.0, "trigger": trigger}))
    (path,) = run.save_figures("png", figure="inter-event")
    pixels = mpl.image.imread(path)[:, :, :3]
    left = pixels[:, : 2 * pixels.shape[1] // 3]  # without the histogram
    is_coloured = np.abs(left - axes_parts.rgb(palette.SENSOR)).max(axis=2) < 0.1
    assert is_coloured.mean(axis=1).max() > 0.7


def test_outputs_share_the_axis_of_time_and_their_zeros_do_not_stretch_the_others() -> None:
    """The offset crosses its set-point: a sample is nearer to it than 1e-4 m, by chance."""
    run = noack.simulate(noack.load("lane_following", {"horizon_s": 10.0, "certificate.prove": False}))
    axes = run._describe("outputs").draw().axes
    assert [panel.get_xlabel() for panel in axes] == ["", "time t [s]"]
    offset, bottom = axes[0].lines[0].get_ydata(), axes[0].get_ylim()[0]
    assert np.min(offset) < 1e-4 < 1e-3 < bottom
    assert np.mean(offset < bottom) < 0.02


def test_an_output_far_within_its_allowed_error_is_drawn() -> None:
    """All of it is below the part of the allowed error from which on distances are shown."""
    outputs = [{"name": "offset", "row": [1.0, 0.0, 0.0, 0.0], "allowed": 1e9}]
    settings = {"horizon_s": 2.0, "outputs": outputs, "certificate.prove": False}
    run = noack.simulate(noack.load("lane_following", settings))
    (axes,) = run._describe("outputs").draw().axes
    low, high = axes.get_ylim()
    offset = axes.lines[0].get_ydata()
    assert low < np.max(offset) < high


@pytest.mark.parametrize("name", ["servo_reference", "dc_motor_load"])
def test_the_norm_is_the_distance_that_is_bounded(name: str) -> None:
    """About a reference, or where the loop rests under its load: x itself is at 1.6, and the load at 0.2."""
    run = noack.simulate(name)
    (norm,) = (curve for curve in run.curves() if curve.name == "‖x − x_r‖ plant")
    assert norm.values[-1] < 0.02
    assert "from its re" in run._describe("state-norm").caption


@pytest.mark.parametrize("case", ["empty", "diverged", "plant only", "deliveries only"])
def test_the_curves_of_a_run_are_those_of_its_figures(case: str) -> None:
    record = CASES[case]()
    curves, figures = run_curves(record), run_figures(record)
    for name, panel in (("errors", ERRORS), ("state-norm", STATE_NORM), ("input", INPUT)):
        (axes,) = figures[name]().draw().axes
        ours = [curve for curve in curves if curve.panel == panel and curve.style.dash != DASHED]
        for line, curve in zip(axes.lines, ours, strict=False):
            colour = tuple(part / 255 for part in curve.style.colour)
            assert to_rgb(line.get_color()) == pytest.approx(colour)
            assert line.get_linewidth() == curve.style.width
            assert np.isin(line.get_xdata(), curve.t_s).all()
    assert all(curve.t_s.shape == curve.values.shape for curve in curves)
    sent = sum(len(curve.t_s) for curve in curves if curve.name in ("delivered", "lost"))
    assert sent == len(record.events())


@pytest.mark.parametrize("entries", [1, 2])
@pytest.mark.parametrize("width_in", [PHONE_IN, SCREEN_IN])
def test_a_long_legend_is_below_the_title(entries: int, width_in: float) -> None:
    def draw(axes: Axes) -> None:
        axes.set_title("Inter-event times")
        for number in range(entries):
            axes.plot([0, 1], label=f"{number}: certified for a plant by its equations")

    figure = one_panel("one", 2.0, draw).draw(width_in)
    (axes,), renderer = figure.axes, FigureCanvasAgg(figure).get_renderer()
    legend = axes.get_legend()
    assert legend is not None
    title = axes._left_title  # type: ignore[attr-defined]
    assert not legend.get_window_extent(renderer).overlaps(title.get_window_extent(renderer))
    assert legend.get_window_extent(renderer).x0 >= 0
