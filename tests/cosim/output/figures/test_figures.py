"""Figures: every curve is named, the same bytes each time, as wide as a paper wants."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.legend import Legend
from matplotlib.text import Text

import noack
from cosim.analysis.summary.quantiles import QuantileSketch
from cosim.output.curves import DASHED, ERRORS, INPUT, STATE_NORM, bound_curves, state_curves
from cosim.output.figures import palette
from cosim.output.figures.figure_description import (
    Axis,
    FigureDescription,
    Line,
    Panel,
    label_text,
    one_panel,
    time_axis,
)
from cosim.output.figures.figure_drawing import draw
from cosim.output.figures.figure_files import inline, save_figure, save_figures
from cosim.output.figures.figure_format import requested_files
from cosim.output.figures.figure_layout import use_figure_width
from cosim.output.figures.run_figures import (
    Transmissions,
    _loss_panel,
    run_curves,
    run_figures,
    states_figure,
)
from cosim.output.figures.timing_figures import later_than
from noack.core.errors import CallerError
from tests.cosim.output.conftest import CASES, HOSTILE
from tests.cosim.output.parsed_page import Page

T_S = np.arange(1.0, 5.0)


def bounds(*labels: str) -> list[Line]:
    curves = bound_curves((label, "x", T_S, 3.0 + T_S, "certified") for label in labels)
    return [
        Line(x=T_S, y=curve.values, label=curve.name, colour=curve.style.colour, dash=curve.style.dash)
        for curve in curves
    ]


def norms(*lines: Line, bounds: Sequence[Line] = ()) -> FigureDescription:
    """A figure of norms on a logarithmic axis."""
    measured = np.concatenate([line.y for line in lines])
    y = Axis(label="norm", logarithmic=True, about=measured, decades=6)
    panel = Panel(title="norms", items=[*lines, *bounds], x=time_axis(lines[0].x), y=y)
    return one_panel("norms", panel, 2.0)


def line(t_s: np.ndarray, y: np.ndarray) -> Line:
    return Line(x=t_s, y=y, label="measured", colour=palette.SENSOR)


def described(case: str) -> dict[str, FigureDescription]:
    """Every figure of a record."""
    envelopes: list[Any] = [
        ("certified", "e_c", T_S, 5 * np.exp(-T_S), "certified"),
        ("certified for every plant of the uncertainty box", "x", T_S, T_S, "certified"),
        ("printed", "inter_event", T_S, T_S, "printed"),
    ]
    figures = run_figures(CASES[case](), envelopes, timed=True)
    return {name: describe() for name, describe in figures.items()}


def legends(axes: Axes) -> list[Legend]:
    """The rows of the legend of axes, each of which is a legend of matplotlib."""
    return [child for child in axes.get_children() if isinstance(child, Legend)]


@pytest.mark.parametrize("case", CASES)
def test_every_figure_is_drawn_with_its_curves_in_the_legend(case: str, tmp_path: Path) -> None:
    """Warnings are errors here: no log of zero, no limits that coincide."""
    for name, figure in described(case).items():
        shown_labels = {label for axes in draw(figure).axes for label in labels(axes)}
        for row in figure.rows:
            lines = [item for item in row.panels[0].items if isinstance(item, Line)]
            assert {line.label for line in lines if line.label} <= shown_labels, name
        if case == "diverged":
            save_figure(figure, tmp_path / f"{name}.png")
            assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_a_figure_without_data_states_that() -> None:
    for name, describe in run_figures(CASES["empty"](), timed=True).items():
        for axes in draw(describe()).axes:
            assert {"no data", "no loss"} & {text.get_text() for text in axes.texts}, name


def labels(axes: Axes) -> list[str]:
    return [text.get_text() for legend in legends(axes) for text in legend.get_texts()]


def test_intervals_and_fates_are_drawn_at_their_times() -> None:
    sent_s = np.array([0.0, 1.0, 1.5, 3.0, 3.25])
    lost, x = np.array([False, True, False, True, False]), np.zeros((10, 1))
    figure = states_figure(
        "model",
        "one draw",
        np.linspace(0, 4, 10),
        state_curves(["x"], np.linspace(0, 4, 10), x, x, x, x),
        Transmissions(sent_s, lost, sent_s[~lost], np.array([True, False, True])),
    )
    _, above, below = draw(figure).axes
    assert labels(above) == ["sent", "sent, lost"]
    assert labels(below) == ["received", "received, forced", "lost"]
    points = {
        line.get_marker(): dict(zip(line.get_xdata(), line.get_ydata(), strict=True))
        for axes in (above, below)
        for line in axes.lines
        if line.get_marker() != "None"
    }
    assert points["D"] == {3.25: 1.75}  # the first event, at 0, has no interval
    assert points["o"] == {1.5: 1.5}  # the received update that was not forced
    sent, lost_ones = above.lines[1], above.lines[3]
    assert sent.get_xdata().tolist() == [1.5, 3.25]
    assert lost_ones.get_ydata().tolist() == [1.0, 1.5]


def test_signal_names_are_drawn_literally() -> None:
    """Not parsed as mathematics, and not hidden for a leading underscore."""
    names = [HOSTILE, "_hidden", "a$b$c", "日本"]
    lines = [replace(line(T_S, T_S), label=label_text(name)) for name in names]
    figure = norms(*lines)
    assert len(labels(draw(figure).axes[0])) == len(names)
    assert "<script" not in inline(figure.captioned(HOSTILE))


def test_curves_that_are_nearly_zero_are_not_drawn_on_a_logarithmic_axis() -> None:
    (curve,) = draw(norms(line(T_S, 1e-320 * T_S))).axes[0].lines
    assert np.isnan(curve.get_ydata()).all()


def test_a_limit_far_beyond_all_losses_is_in_the_label() -> None:
    """A bar for each number up to a limit of a million takes minutes."""
    panel = _loss_panel("losses", "consecutive losses", "bursts", np.array([1, 1, 3]), 1_000_000)
    axes = draw(one_panel("losses", panel, 2.0)).axes[0]
    assert axes.get_xlabel() == "consecutive losses (allowed: 1,000,000)"
    assert axes.get_xlim()[1] < 5
    assert [bar.get_height() for bar in axes.patches] == [2, 1]


def test_a_near_limit_is_drawn_and_bars_are_few() -> None:
    panel = _loss_panel("losses", "consecutive losses", "bursts", np.array([1, 200_000]), 200_000)
    axes = draw(one_panel("losses", panel, 2.0)).axes[0]
    assert axes.get_xlabel() == "consecutive losses"
    assert len(axes.patches) == 2
    assert axes.get_xlim()[1] > 200_000


def test_a_curve_of_zeros_is_not_drawn_on_a_logarithmic_axis() -> None:
    curve, zeros = draw(norms(line(T_S, T_S), line(T_S, 0 * T_S))).axes[0].lines
    assert np.isnan(zeros.get_ydata()).all()
    np.testing.assert_array_equal(curve.get_ydata(), T_S)


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
    for user_settings in ({}, {"lines.linewidth": 9, "axes.titlepad": 40, "svg.hashsalt": "other"}):
        with mpl.rc_context(user_settings):
            save_figure(norms(line(T_S, T_S)), path)
        contents.add(path.read_bytes())
    (content,) = contents
    for trace in (b"http://purl", b"matplotlib.org", b"dc:date", b"Software"):
        assert trace not in content


@pytest.mark.parametrize("factor", [1e-13, 1e10])
def test_characters_that_the_fonts_of_latex_replace_are_written_as_mathematics(factor: float) -> None:
    """Computer Modern has a macron, a ligature and a dotless i in the place of ¹, ² and ³."""
    y = Axis(label="age [µs], turn [°], force [N/m²]", logarithmic=True)
    panel = Panel(title="m³", items=[line(T_S, factor * 10 ** (T_S - 2))], x=time_axis(T_S), y=y)
    with use_figure_width(3.5, latex=True):
        figure = draw(one_panel("norms", panel, 2.0))
        labels = [*figure.axes[0].get_yticklabels(), *figure.findobj(Text)]
        texts = [text.get_text() for text in labels if isinstance(text, Text)]
    assert f"$10^{{{round(np.log10(factor))}}}$" in texts
    plain = "".join(part for text in texts for part in text.split("$")[::2])
    assert not set(plain) & set("µ°¹²³⁻⁰")


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
        save_figure(norms(line(T_S, T_S)), tmp_path / "figure.eps")
    for width, points in ((None, 252.0), ("page", 515.52), (5, 360.0)):
        files = requested_files("pdf", width)
        (path,) = save_figures([norms(line(T_S, T_S))], tmp_path / "page.html", files)
        content = path.read_bytes()
        box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ", content)
        assert box is not None
        assert float(box[1]) == pytest.approx(points, abs=0.01)
        assert b"Cmr10" in content  # the font of LaTeX
        assert b"/Type3" not in content.replace(b" ", b"")  # refused by publishers
    states = run.directory / "report-figures/states.svg"
    assert states.read_text().count('width="720pt"') == 1


def test_a_large_figure_becomes_a_bitmap(monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line(x=np.arange(3.0), y=np.ones(3), colour=(0, 0, 0))
    figure = one_panel("a", Panel(items=[line], x=Axis(), y=Axis()), 1.0)
    figure = figure.captioned("", 'named "so"')
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
        lines = [item for item in figures[name]().rows[0].panels[0].items if isinstance(item, Line)]
        ours = [curve for curve in curves if curve.panel == panel and curve.style.dash != DASHED]
        for line, curve in zip(lines, ours, strict=False):
            np.testing.assert_array_equal(line.x, curve.t_s)
            np.testing.assert_array_equal(line.y, curve.values)
            assert line.colour == curve.style.colour
    assert all(curve.t_s.shape == curve.values.shape for curve in curves)
    sent = sum(len(curve.t_s) for curve in curves if curve.name in ("delivered", "lost"))
    assert sent == len(record.events())
