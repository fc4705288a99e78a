import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from PIL import ImageColor

from cosim.analysis.value_reduction import QuantileSketch
from cosim.output import palette
from cosim.output.figure_description import (
    Axis,
    FigureDescription,
    Line,
    Panel,
    bound_lines,
    one_panel,
    plain,
    time_axis,
)
from cosim.output.figure_drawing import draw
from cosim.output.figure_files import inline, save_figure
from cosim.output.figure_layout import figure_width, rgb, settings
from cosim.output.page_kit import PAGES
from cosim.output.run_figures import (
    Trajectory,
    Transmissions,
    run_figures,
    states_figure,
)
from cosim.output.timing_figures import later_than
from noack.core.errors import CallerError
from tests.cosim.output.conftest import CASES, HOSTILE
from tests.cosim.output.test_palette import BACKGROUNDS, luminance

CONTROLLER = rgb(palette.CONTROLLER)
UNITS = re.compile(r"\[(s|wall µs)\]$")
UNITLESS = re.compile(
    r"x_\d|norm|input|count|share of steps at least as late|bursts|consecutive .*"
)
"""Dimensionless quantities, and those in the model's own units."""
T_S = np.arange(1.0, 5.0)


def bounds(*labels: str) -> list[Line]:
    return bound_lines((label, T_S, 3.0 + T_S, "certified") for label in labels)


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
    found = run_figures(CASES[case](), envelopes, timed=True)
    return {name: describe() for name, describe in found.items()}


def drawn_for(case: str) -> dict[str, Figure]:
    return {name: draw(figure) for name, figure in described(case).items()}


@pytest.fixture(scope="module", params=CASES)
def drawn(request: pytest.FixtureRequest) -> dict[str, Figure]:
    return drawn_for(request.param)


def test_every_axis_has_a_label_with_its_unit(drawn: dict[str, Figure]) -> None:
    for name, figure in drawn.items():
        for place, axes in enumerate(figure.axes):
            beside = place == 1 and name in ("inter-event", "latency")
            shared = axes.xaxis.get_tick_params().get("labelbottom") is False
            for label, is_hidden in ((axes.get_ylabel(), beside), (axes.get_xlabel(), shared)):
                has_unit = UNITS.search(label) or UNITLESS.fullmatch(label)
                assert is_hidden or has_unit or (name == "states" and label), (name, label)


def test_every_figure_can_be_saved(tmp_path: Path) -> None:
    """Warnings are errors here: no log of zero, no limits that coincide."""
    for name, figure in described("diverged").items():
        save_figure(figure, tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


WIDE = [case for case in CASES if case != "two steps"]
"""Its states hardly change, and matplotlib's common offset of their numbers needs more room."""


@pytest.fixture(
    scope="module", params=[(case, width_in) for width_in in (3.5, 10.0) for case in WIDE]
)
def as_wide(request: pytest.FixtureRequest) -> Iterator[dict[str, Figure]]:
    case, width_in = request.param
    with figure_width(width_in):
        yield drawn_for(case)


def legends(axes: Axes) -> list[Legend]:
    """The rows of the legend of axes, each of which is a legend of matplotlib."""
    return [one for one in axes.get_children() if isinstance(one, Legend)]


def test_nothing_is_cut_off_and_no_texts_overlap(as_wide: dict[str, Figure]) -> None:
    for name, figure in as_wide.items():
        with settings():
            figure.draw_without_rendering()
            box, size_in = figure.get_tightbbox(), figure.get_size_inches()
            assert min(box.x0, box.y0) >= 0, name
            assert box.x1 <= size_in[0], name
            assert box.y1 <= size_in[1], name
            for axes in figure.axes:
                heads = [*axes.texts, axes.yaxis.get_offset_text(), axes._left_title]
                for legend in legends(axes):
                    assert legend.get_window_extent().y0 >= axes.bbox.y1 - 1, name
                    heads += legend.get_texts()
                boxes = [text.get_window_extent() for text in heads if text.get_text()]
                for i, one in enumerate(boxes):
                    assert not any(one.overlaps(other) for other in boxes[:i]), name


def test_a_figure_without_data_states_that() -> None:
    for name, describe in run_figures(CASES["empty"](), timed=True).items():
        for axes in draw(describe()).axes:
            assert {"no data", "no loss"} & {text.get_text() for text in axes.texts}, name


def spike(k: int) -> np.ndarray:
    y = np.zeros(k)
    y[k // 3] = 7.0
    return y


def test_a_long_curve_is_drawn_with_its_peaks_and_few_points(tmp_path: Path) -> None:
    k = 200_000
    figure = norms(line(np.arange(k) * 0.002, 1.0 + spike(k)))
    (drawn,) = draw(figure).axes[0].lines
    assert 8.0 in drawn.get_ydata()
    assert len(drawn.get_ydata()) <= 2400
    save_figure(figure, tmp_path / "long.svg")
    assert (tmp_path / "long.svg").stat().st_size < 1_000_000


def labels(axes: Axes) -> list[str]:
    return [text.get_text() for legend in legends(axes) for text in legend.get_texts()]


@pytest.mark.parametrize(("mode", "head"), [("model", "MB-ET"), ("zoh", "ZOH-ET")])
def test_intervals_and_fates_are_drawn_at_their_times(mode: Any, head: str) -> None:
    """The figure is named as in the paper."""
    sent_s = np.array([0.0, 1.0, 1.5, 3.0, 3.25])
    lost, x = np.array([False, True, False, True, False]), np.zeros((10, 1))
    figure = states_figure(
        mode,
        "one draw out of 1,000",
        Trajectory(["x"], np.linspace(0, 4, 10), x, x, x, x),
        Transmissions(sent_s, lost, sent_s[~lost], np.array([True, False, True])),
    )
    first, above, below = draw(figure).axes
    assert first.get_title("left") == f"{head}: one draw out of 1,000"
    assert labels(above) == ["sent", "sent, lost"]
    assert labels(below) == ["received", "received, forced", "lost"]
    found = {
        line.get_marker(): dict(zip(line.get_xdata(), line.get_ydata(), strict=True))
        for axes in (above, below)
        for line in axes.lines
        if line.get_marker() != "None"
    }
    assert found["D"] == {3.25: 1.75}  # the first event, at 0, has no interval
    assert found["o"] == {1.5: 1.5}  # the received update that was not forced
    sent, lost_ones = above.lines[1], above.lines[3]
    assert sent.get_xdata().tolist() == [1.5, 3.25]
    assert lost_ones.get_ydata().tolist() == [1.0, 1.5]


def test_signal_names_are_drawn_literally() -> None:
    """Not parsed as mathematics, and not hidden for a leading underscore."""
    names = [HOSTILE, "_hidden", "a$b$c", "日本"]
    lines = [replace(line(T_S, T_S), label=plain(name)) for name in names]
    figure = norms(*lines)
    assert len(labels(draw(figure).axes[0])) == len(names)
    assert "<script" not in inline(figure.captioned(HOSTILE))


def test_the_distribution_of_lateness_is_exact_at_its_ends() -> None:
    late_us = np.random.default_rng(1).lognormal(3, 1, 5000)
    found_us, share = later_than(QuantileSketch.of([late_us]))
    assert (found_us[0], found_us[-1]) == (late_us.min(), late_us.max())
    assert (share[0], share[-1]) == (1, 1 / 5000)
    assert np.array_equal(share, [(late_us >= value).mean() for value in found_us])
    assert len(share) < 300


@pytest.mark.parametrize("ending", ["svg", "png", "pdf"])
def test_the_same_figure_gives_the_same_bytes(tmp_path: Path, ending: str) -> None:
    path, found = tmp_path / f"figure.{ending}", set()
    for own in ({}, {"lines.linewidth": 9, "axes.titlepad": 40, "svg.hashsalt": "other"}):
        with mpl.rc_context(own):
            save_figure(norms(line(T_S, T_S)), path)
        found.add(path.read_bytes())
    (content,) = found
    for trace in (b"http://purl", b"matplotlib.org", b"dc:date", b"Software"):
        assert trace not in content


def test_another_file_extension_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match=r"figure\.eps: a figure is saved as \.svg, \.png, \.pdf"):
        save_figure(FigureDescription(name="none", rows=[]), tmp_path / "figure.eps")


def contrast(one: str, other: str) -> float:
    low, high = sorted(luminance(ImageColor.getrgb(colour)[:3]) for colour in (one, other))
    return (high + 0.05) / (low + 0.05)


def test_the_palette_is_tested_on_the_backgrounds_of_the_page() -> None:
    css = (PAGES / "report.css").read_text()
    found = {ImageColor.getrgb(colour) for colour in re.findall(r"--paper: (#\w+)", css)}
    assert found <= set(BACKGROUNDS.values())


@pytest.mark.parametrize("paper", ["#ffffff", "#14181d"])
def test_text_has_enough_contrast(paper: str) -> None:
    """4.5 to 1, WCAG's minimum for text."""
    css = (PAGES / "report.css").read_text()
    (block,) = [block for block in css.split(":root") if f"--paper: {paper}" in block][:1]
    shade = re.search(r"--shade: (#\w+)", block)
    assert shade
    for name, colour in re.findall(r"--(ink|quiet|good|bad|doubt): (#\w+)", block):
        assert contrast(colour, paper) >= 4.5, name
        assert contrast(colour, shade[1]) >= 4.5, name
