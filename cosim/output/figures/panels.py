"""Places of the panels of a figure, in inches, and their legends.

A figure is drawn for its width, not scaled to it: texts keep a size that one can read. Margins are
constants, and the height of a figure follows from the heights of its axes: matplotlib's layout engines
fit axes into a figure of a given height. With them a report of 20 s took 10 % (constrained) or 22 %
(tight) more CPU time.
"""

import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cosim.output.figures.figure_format import SCREEN_IN

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure

POINTS_PER_IN = 72
_EM_PER_CHARACTER = 0.6
"""Mean width of a character of a legend; a label of an axis may be a little longer than the axis."""
_TITLE_CHARACTERS = 31
"""Room for a title beside a legend."""
_LEAST_SCALE, _PAPER_LINES = 0.6, 0.65
"""In a paper: least factor of the heights of axes, and factor of the widths of lines."""
BAR_IN = 0.2
"""Width of a colour bar."""
_BESIDE_GAP_IN = 0.27
_SHORT_LABELS = (
    ("certified for every plant of the uncertainty box", "certified: all plants"),
    ("certified for the scenario's ", "certified: "),
    ("bound, given ", "given "),
)
"""Parts of the labels of bounds, and what the legends of papers have instead."""
_MARKUP = re.compile(r"[$\\{}^_]|(?<=\\)\w+")


class Margins(NamedTuple):
    """Spaces around axes in inches."""

    left: float
    right: float
    below: float
    above: float
    """For the title."""
    gap: float
    """Between two panels without labels between them."""
    legend_row: float
    handle: float
    """An entry of a legend without its text."""
    untitled: float = 0.08


SCREEN = Margins(1.15, 0.2, 0.55, 0.34, 0.22, 0.19, 0.6)
PAPER = Margins(0.76, 0.17, 0.42, 0.24, 0.16, 0.155, 0.4)


@dataclass(eq=False)
class Panels:
    """Axes side by side: a row of a figure."""

    axes: "Sequence[Axes]"
    height_in: float
    """Of the axes, in a figure for the screen."""
    columns: int = 0
    """Number of places in the row; 0: as many as axes."""
    widest_in: float = np.inf
    """Largest width of an axes."""
    beside_in: float = 0.0
    """Width of the last axes, which shares the vertical axis of the first; 0: all have the same width."""
    is_tight: bool = False
    """Whether the axes have a common vertical axis."""
    left_in: float = 0.0
    """Least space at the left of each axes."""
    below_in: float = 0.0
    """Further space below the axes."""
    bar: "Axes | None" = None
    """Axes of a colour bar at the right of this row and of those below it."""


def margins(figure: "Figure") -> Margins:
    """Return the margins in a figure of this width."""
    return SCREEN if figure.get_figwidth() >= SCREEN_IN else PAPER


def columns(figure: "Figure", most: int, narrowest_in: float) -> int:
    """Return how many panels have room side by side."""
    return max(1, min(most, int(figure.get_figwidth() / narrowest_in)))


def character_in() -> float:
    """Return the mean width of a character of a legend."""
    import matplotlib as mpl

    return _EM_PER_CHARACTER * float(mpl.rcParams["legend.fontsize"]) / POINTS_PER_IN


def labels_in(texts: Iterable[str]) -> float:
    """Return the width of texts in place of numbers at a vertical axis, and of its label."""
    return (max(map(len, texts), default=0) + 2) * character_in() + BAR_IN


def add_colour_bar(figure: "Figure", rows: Sequence[Panels], colours: "ScalarMappable", **style: Any) -> None:
    """Draw the bar that explains the colours, at the right of all rows; ``style`` is matplotlib's."""
    rows[0].bar = figure.add_axes((0, 0, 1, 1))
    figure.colorbar(colours, cax=rows[0].bar, **style)


def place(figure: "Figure", rows: Sequence[Panels]) -> None:
    """Give the axes of all rows their places and legends, and the figure its height."""
    space, width_in, top_in = margins(figure), figure.get_figwidth(), 0.0
    bar = rows[0].bar
    right_in = 0.0 if bar is None else 4 * BAR_IN
    scale = min(max(width_in / SCREEN_IN, _LEAST_SCALE), 1.0)
    boxes: list[tuple[Axes, tuple[float, float, float, float]]] = []
    for row in rows:
        height_in = scale * row.height_in
        spans = _spans(row, width_in, space, right_in)
        if space is PAPER:
            _thin_lines(row.axes)
        top_in += _draw_legends(figure, row, spans)
        for axes, (left, wide) in zip(row.axes, spans, strict=True):
            boxes.append((axes, (left, top_in, wide, height_in)))
        numbered = any(axes.xaxis.get_tick_params()["labelbottom"] for axes in row.axes)
        top_in += height_in + (space.below if numbered else space.gap) + row.below_in
    if bar is not None:
        first, last = boxes[0][1], boxes[-1][1]
        right = max(left + wide for _, (left, _, wide, _) in boxes)
        boxes.append((bar, (right + BAR_IN, first[1], BAR_IN, last[1] + last[3] - first[1])))
    figure.set_figheight(top_in)
    for axes, (left, top, wide, high) in boxes:
        axes.set_position((left / width_in, 1 - (top + high) / top_in, wide / width_in, high / top_in))
        # A factor of all numbers, e.g. 1e-6: above the axes it would overlap the title.
        axes.yaxis.get_offset_text().set(x=-0.05 / wide, horizontalalignment="right")
        if space is PAPER:
            _break_labels(axes, wide, high)
    figure.align_ylabels()


def _spans(row: Panels, width_in: float, space: Margins, right_in: float) -> list[tuple[float, float]]:
    """Return left end and width of each axes of a row."""
    left_in = max(space.left, row.left_in)
    if row.beside_in:
        beside_in = row.beside_in * max(min(width_in / SCREEN_IN, 1.0), 0.4)
        main_in = width_in - left_in - space.right - right_in - beside_in - _BESIDE_GAP_IN
        return [(left_in, main_in), (left_in + main_in + _BESIDE_GAP_IN, beside_in)]
    count = row.columns or len(row.axes)
    between_in = space.gap if row.is_tight else left_in
    share_in = (width_in - left_in - space.right - right_in - (count - 1) * between_in) / count
    wide_in = min(share_in, row.widest_in)
    return [(left_in + i * (share_in + between_in), wide_in) for i in range(len(row.axes))]


def _draw_legends(figure: "Figure", row: Panels, spans: Sequence[tuple[float, float]]) -> float:
    """Draw a legend above each axes with labels; return the height above the row in inches.

    A legend of one line is at the right of the title, if there is room for both; else it is below it.
    """
    space, width_in, heights_in = margins(figure), figure.get_figwidth(), [0.0]
    entries = [_legend_entries(axes, space) for axes in row.axes]
    is_only = sum(map(bool, entries)) == 1  # it ends where the row ends
    for axes, handles, (left_in, wide_in) in zip(row.axes, entries, spans, strict=True):
        title, lines, end = axes.get_title("left"), 0, row.axes[-1] if is_only else axes
        if handles:
            beside_in = (sum(spans[-1]) - left_in) if is_only else wide_in
            count, room_in = len(handles), beside_in - _TITLE_CHARACTERS * character_in()
            if sum(_legend_widths_in([*handles], space)) > room_in:
                count = _legend_columns([*handles], width_in - 2 * space.right, space)
                lines = -(-len(handles) // count)
            axes.legend(
                [*handles.values()], [*handles], ncols=count, bbox_to_anchor=(1, 1),
                bbox_transform=end.transAxes,
            )  # fmt: skip
        if lines:
            axes.set_title(title, loc="left", pad=POINTS_PER_IN * space.legend_row * lines + 4)
        above_in = space.above if title or (handles and not lines) else space.untitled
        heights_in.append(above_in + space.legend_row * lines)
    return max(heights_in)


def _legend_entries(axes: "Axes", space: Margins) -> dict[str, "Artist"]:
    """Return what represents each label in the legend, each label once; in papers, they are shorter."""
    entries: dict[str, Artist] = {}
    for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
        for long, brief in _SHORT_LABELS if space is PAPER else ():
            label = label.replace(long, brief)
        entries.setdefault(label, handle)
    return entries


def _legend_widths_in(labels: Sequence[str], space: Margins) -> list[float]:
    """Return the widths of the entries of a legend."""
    return [space.handle + character_in() * len(_MARKUP.sub("", label)) for label in labels]


def _legend_columns(labels: Sequence[str], room_in: float, space: Margins) -> int:
    """Return the largest number of columns for which there is room; entries go down the columns."""
    widths_in = _legend_widths_in(labels, space)
    for count in range(len(labels), 1, -1):
        if sum(column.max() for column in np.array_split(widths_in, count)) <= room_in:
            return count
    return 1


def _thin_lines(panels: "Sequence[Axes]") -> None:
    """Make lines thinner and markers smaller, for a paper."""
    for line in (line for axes in panels for line in axes.lines):
        line.set_linewidth(_PAPER_LINES * line.get_linewidth())
        line.set_markersize(_PAPER_LINES * line.get_markersize())
        line.set_markeredgewidth(_PAPER_LINES * line.get_markeredgewidth())


def _break_labels(axes: "Axes", width_in: float, height_in: float) -> None:
    """Break labels that are longer than their axes."""
    for axis, length_in in ((axes.xaxis, width_in), (axes.yaxis, height_in)):
        most = max(int(length_in / (0.85 * character_in())), 8)
        axis.set_label_text(textwrap.fill(axis.get_label_text(), most, break_long_words=False))
