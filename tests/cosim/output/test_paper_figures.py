"""Figures for papers: PDF with the fonts of LaTeX, written without a LaTeX."""

import re
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from typer.testing import CliRunner

import noack
from cosim.cli import app
from cosim.output.figure_description import Axis, FigureDescription, Line, Panel, one_panel
from cosim.output.figure_files import (
    characters_of_paper_fonts,
    file_content,
    save_figures,
)
from cosim.output.figure_format import FigureFormat, figure_files
from cosim.output.figure_style import settings
from noack.core.errors import CallerError


def saved(figure: Figure, path: Path) -> None:
    path.write_bytes(file_content(figure, FigureFormat(path.suffix[1:])))


def figure_of(title: str) -> Figure:
    with settings():
        figure = Figure(figsize=(4, 3))
        axes = figure.subplots()
        axes.set(title=title.replace("$", r"\$"), xlabel=r"norm $\|e_c\|$", yscale="log")
        axes.plot(np.arange(1, 9), 10.0 ** -np.arange(1, 9))
    return figure


def test_texts_have_the_fonts_of_latex_only_while_a_figure_is_saved(tmp_path: Path) -> None:
    figure = figure_of("title")
    saved(figure, tmp_path / "before.svg")
    before = dict(mpl.rcParams)
    saved(figure, tmp_path / "a.pdf")
    saved(figure, tmp_path / "after.svg")
    assert (tmp_path / "after.svg").read_bytes() == (tmp_path / "before.svg").read_bytes()
    assert dict(mpl.rcParams) == before
    assert {text.get_fontfamily()[0] for text in figure.findobj(Text)} == {"sans-serif"}
    pdf = (tmp_path / "a.pdf").read_bytes()
    assert b"Cmr10" in pdf
    assert b"/Type3" not in pdf.replace(b" ", b"")  # refused by publishers


def test_computer_modern_has_other_characters_at_the_place_of_some(tmp_path: Path) -> None:
    figure = figure_of("lane_following <$x_s$>")
    figure.axes[0].set_xticks([1.0, 2.0], ["a_b", "c|d"])
    saved(figure, tmp_path / "before.svg")
    with characters_of_paper_fonts(figure):
        figure.draw_without_rendering()
        texts = {text.get_text() for text in figure.findobj(Text)}
        assert {r"a$\_$b", "c$|$d"} <= texts
    saved(figure, tmp_path / "after.svg")
    assert (tmp_path / "after.svg").read_bytes() == (tmp_path / "before.svg").read_bytes()
    for text, written in (("a_b $x_c$ {1}", r"a$\_$b $x_c$ $\{$1$\}$"), (r"5 \$_", r"5 \$$\_$")):
        figure.axes[0].set_title(text, loc="left")
        with characters_of_paper_fonts(figure):
            assert figure.axes[0].get_title("left") == written
    saved(figure, tmp_path / "a.pdf")
    assert b"Cmtt10" in (tmp_path / "a.pdf").read_bytes()


def test_nothing_is_drawn_without_a_format(tmp_path: Path) -> None:
    def drawn(name: str) -> FigureDescription:
        x = np.arange(3.0)
        line = Line(x=x, y=x, colour=(0, 0, 0))
        return one_panel(name, Panel(items=[line], x=Axis(), y=Axis()), 1.0)

    assert save_figures(map(drawn, "ab"), tmp_path / "p.html", None) == []
    two = map(drawn, "ab")
    found = save_figures(two, tmp_path / "p.html", figure_files("pdf"))
    assert found == [tmp_path / "p-figures/a.pdf", tmp_path / "p-figures/b.pdf"]


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
    for width, points in ((None, 252.0), ("column", 252.0), ("page", 515.52), (5, 360.0)):
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
