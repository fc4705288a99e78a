"""Figures for papers: PDF with the fonts of LaTeX, written without a LaTeX."""

import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.text import Text
from typer.testing import CliRunner

import noack
from cosim.cli import app
from cosim.output.figure_description import Axis, Line, Panel, one_panel
from cosim.output.figure_drawing import draw
from cosim.output.figure_files import file_content
from cosim.output.figure_format import FigureFormat
from cosim.output.figure_layout import figure_width
from noack.core.errors import CallerError


def test_texts_of_a_pdf_have_the_fonts_of_latex() -> None:
    """Computer Modern has other characters at the places of some, which are mathematics then."""
    x = np.arange(1.0, 9.0)
    line = Line(x=x, y=10.0**-x, colour=(0, 0, 0), label=r"norm $\|e_c\|$")
    ticks = {1.0: "a_b", 2.0: "c|d"}
    y = Axis(label=r"5 \$_", logarithmic=True)
    panel = Panel(title="lane_following <$x_s$>", items=[line], x=Axis(ticks=ticks), y=y)
    figure, before = one_panel("figure", panel, 2.0), dict(mpl.rcParams)
    with figure_width(3.5, latex=True):
        drawn = draw(figure)
        drawn.draw_without_rendering()
    assert dict(mpl.rcParams) == before
    texts = {text.get_text() for text in drawn.findobj(Text)}
    written = {r"a$\_$b", "c$|$d", r"5 \$$\_$", r"lane$\_$following $<$$x_s$$>$"}
    assert written <= texts
    pdf = file_content(figure, FigureFormat.PDF, 3.5)
    for font in (b"Cmr10", b"Cmb10"):
        assert font in pdf
    assert b"/Type3" not in pdf.replace(b" ", b"")  # refused by publishers
    assert written.isdisjoint(text.get_text() for text in draw(figure).findobj(Text))


def test_the_figures_of_a_report_are_written(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("double_integrator", {"horizon_s": 0.3}), runs=tmp_path)
    words = ["report", str(run.directory), "--format", "pdf", "--json"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    names = sorted(path.name for path in (run.directory / "report-figures").iterdir())
    assert names == [
        "errors.pdf", "input.pdf", "inter-event.pdf", "losses.pdf", "state-norm.pdf", "states.pdf",
    ]  # fmt: skip
    with pytest.raises(CallerError, match='"eps": a figure is saved as svg, png, pdf'):
        run.save_figures("eps")


def test_figures_are_as_wide_as_a_paper_wants_with_legible_texts(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("double_integrator", {"horizon_s": 0.3}), runs=tmp_path)
    for width, points in ((None, 252.0), ("page", 515.52), (5, 360.0)):
        for path in run.save_figures("pdf", width):
            box = re.search(rb"/MediaBox \[ ?0 0 ([\d.]+) ", path.read_bytes())
            assert box is not None
            assert float(box[1]) == pytest.approx(points, abs=0.01)
    drawn = run.save_figures("svg")
    assert drawn[0].read_text().count('width="720pt"') == 1


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--width", "column"], "--width: is the width of the figures of --format"),
        (["--format", "pdf", "--width", "wide"], "width wide: expected column, page, or inches"),
        (["--format", "pdf", "--width", "0.1"], "width 0.1: expected column, page, or inches"),
        (["--format", "pdf", "--width", "nan"], "width nan: expected column, page, or inches"),
    ],
)
def test_a_wrong_width_is_refused(words: list[str], message: str) -> None:
    done = CliRunner().invoke(app, ["campaign", "mb_vs_zoh", *words])
    assert done.exit_code == 2
    assert message in done.stderr
