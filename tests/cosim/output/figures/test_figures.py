"""Figures: every curve is named, the same bytes each time, as wide as a paper wants."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.patches import Rectangle
from matplotlib.text import Text

import noack
from cosim.analysis.summary.quantiles import QuantileSketch
from cosim.output.curves import DASHED, ERRORS, INPUT, STATE_NORM, Curve, CurveStyle, state_curves
from cosim.output.figures import palette
from cosim.output.figures.axes_parts import draw_line, label_text
from cosim.output.figures.figure_files import inline, save_figure, save_figures
from cosim.output.figures.figure_format import requested_files
from cosim.output.figures.page_figure import PageFigure, one_panel
from cosim.output.figures.run_figures import (
    Transmissions,
    draw_losses,
    draw_norms,
    draw_states,
    run_curves,
    run_figures,
)
from cosim.output.figures.timing_figures import later_than
from noack.core.errors import CallerError
from tests.cosim.output.conftest import CASES, HOSTILE
from tests.cosim.output.parsed_page import Page

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


@pytest.mark.parametrize("width_in", [3.0, 3.5, 7.16, 10.0])
@pytest.mark.parametrize("count", [1, 3, 7])
def test_a_legend_covers_neither_the_title_nor_the_axes(width_in: float, count: int) -> None:
    names = [f"certified for every plant of the uncertainty {i}" for i in range(count)]
    figure = norms(*(curve(T_S, T_S, name) for name in names)).draw(width_in)
    figure.draw_without_rendering()
    (axes,) = figure.axes
    legend = axes.get_legend()
    assert legend is not None
    box = legend.get_window_extent()
    titles = [child for child in axes.get_children() if isinstance(child, Text) and child.get_text()]
    for other in (axes.get_window_extent(), *(title.get_window_extent() for title in titles)):
        assert (
            min(box.x1, other.x1) <= max(box.x0, other.x0)
            or box.y0 >= other.y1 - 1
            or (box.y1 <= other.y0 + 1)
        )
    assert figure.bbox.x0 <= box.x0
    assert figure.bbox.y1 >= box.y1


def test_a_figure_without_data_states_that() -> None:
    for name, describe in run_figures(CASES["empty"](), timed=True).items():
        for axes in describe().draw().axes:
            assert {"no data", "no loss"} & {text.get_text() for text in axes.texts}, name


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


def test_signal_names_are_drawn_literally() -> None:
    """Not parsed as mathematics, and not hidden for a leading underscore."""
    names = [HOSTILE, "_hidden", "a$b$c", "日本"]
    figure = norms(*(curve(T_S, T_S, label_text(name)) for name in names))
    assert len(labels(figure.draw().axes[0])) == len(names)
    assert "<script" not in inline(replace(figure, caption=HOSTILE))


def test_curves_that_are_nearly_zero_are_not_drawn_on_a_logarithmic_axis() -> None:
    (line,) = norms(curve(T_S, 1e-320 * T_S)).draw().axes[0].lines
    assert np.isnan(np.asarray(line.get_ydata())).all()


def loss_axes(values: np.ndarray, limit: int) -> Axes:
    def draw(axes: Axes) -> None:
        draw_losses(axes, "losses", "consecutive losses", "bursts", values, limit)

    return one_panel("losses", 2.0, draw).draw().axes[0]


def test_a_limit_far_beyond_all_losses_is_in_the_label() -> None:
    """A bar for each number up to a limit of a million takes minutes."""
    axes = loss_axes(np.array([1, 1, 3]), 1_000_000)
    assert axes.get_xlabel() == "consecutive losses (allowed: 1,000,000)"
    assert axes.get_xlim()[1] < 5
    assert [bar.get_height() for bar in axes.patches if isinstance(bar, Rectangle)] == [2, 1]


def test_a_near_limit_is_drawn_and_bars_are_few() -> None:
    axes = loss_axes(np.array([1, 200_000]), 200_000)
    assert axes.get_xlabel() == "consecutive losses"
    assert len(axes.patches) == 2
    assert axes.get_xlim()[1] > 200_000


def test_a_curve_of_zeros_is_not_drawn_on_a_logarithmic_axis() -> None:
    line, zeros = norms(curve(T_S, T_S), curve(T_S, 0 * T_S, "zeros")).draw().axes[0].lines
    assert np.isnan(np.asarray(zeros.get_ydata())).all()
    np.testing.assert_array_equal(line.get_ydata(), T_S)


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


def test_numbers_of_a_logarithmic_axis_are_plain_or_powers() -> None:
    def ticks(factor: float) -> set[str]:
        figure = norms(curve(T_S, factor * 10**T_S)).draw()
        figure.draw_without_rendering()
        return {tick.label1.get_text() for tick in figure.axes[0].yaxis.majorTicks}

    assert r"$\mathdefault{0.1}$" in ticks(1e-3)
    assert r"$\mathdefault{10^{-6}}$" in ticks(1e-8)


def test_the_figures_of_a_report_are_written_as_wide_as_a_paper_wants(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("double_integrator", {"horizon_s": 0.3}))
    names = {path.stem for path in run.save_figures("svg")}
    assert names == {"errors", "input", "inter-event", "losses", "state-norm", "states"}
    assert [path.name for path in run.save_figures("png", figure="losses")] == ["losses.png"]
    with pytest.raises(CallerError, match='"loss": no such figure of this run; it has states, '):
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


def test_a_large_figure_becomes_a_bitmap(monkeypatch: pytest.MonkeyPatch) -> None:
    def draw(axes: Axes) -> None:
        draw_line(axes, np.arange(3.0), np.ones(3), (0, 0, 0))

    figure = one_panel("a", 1.0, draw, description='named "so"')
    assert not Page(inline(figure)).attributes("img")
    monkeypatch.setattr("cosim.output.figures.figure_files._MOST_SVG_CHARACTERS", 10)
    (image,) = Page(inline(figure)).attributes("img")
    assert image["alt"] == 'named "so"'
    assert (image["src"] or "").startswith("data:image/png;base64,")


@pytest.mark.parametrize("case", CASES)
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
