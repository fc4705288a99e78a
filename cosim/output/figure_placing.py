"""Places the panels of a figure, and the rows of their legends, in inches.

Fixed places need no layout engine, align the figures of a page with each other, and give the same
figure the same bytes. Read :func:`place_panels` first.
"""

import re
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cosim.output.figure_description import FigureDescription, Panel, Row
from cosim.output.figure_style import layout

BAR_IN = 0.2
"""Width of the bar that explains the colours."""
_BESIDE_IN, _BESIDE_GAP_IN, _UNTITLED_IN = 2.0, 0.27, 0.08
_TITLE_CHARACTERS = 31
"""Room for a title beside a legend."""
_IN_SHORT = (
    ("certified for every plant of the uncertainty ", "certified: "),
    ("certified for the scenario's ", "certified: "),
    ("bound, given ", "given "),
)
"""What the legends of papers leave out of the labels of bounds."""
_MARKUP = re.compile(r"[$\\{}^_]|(?<=\\)\w+")


class Box(NamedTuple):
    """A rectangle in inches, from the figure's upper left corner."""

    left: float
    top: float
    width: float
    height: float


class Place(NamedTuple):
    """A panel and its axes."""

    panel: Panel
    box: Box
    has_x: bool
    """Whether the horizontal axis has its label and numbers here."""
    has_y: bool
    is_beside: bool = False
    """Whether it has the vertical axis of the place before it."""


def place_panels(described: FigureDescription) -> tuple[list[Place], tuple[float, float]]:
    """Place the panels; return them, and width and height of the figure in inches."""
    space, places = layout(), list[Place]()
    top_in = 0.0
    if described.heading:
        top_in = _head_in(described.rows[0].panels[0].labels, space.width_in)
    right_in = space.right_in + (4 * BAR_IN if described.scale is not None else 0.0)
    for row in described.rows:
        columns = _columns(row, space.width_in)
        for first in range(0, len(row.panels), columns):
            has_heading = bool(described.heading) and not places
            line = _place_line(row, first, columns, top_in, right_in, has_heading=has_heading)
            places += line
            box = line[0].box
            numbered = any(place.has_x for place in line)
            top_in = box.top + box.height + (space.below_in if numbered else space.gap_in)
    return places, (space.width_in, top_in)


def _columns(row: Row, room_in: float) -> int:
    columns = min(row.columns or len(row.panels), len(row.panels))
    return max(min(columns, int(room_in / row.narrowest_in)), 1) if row.narrowest_in else columns


def _place_line(
    row: Row, first: int, columns: int, top_in: float, right_in: float, *, has_heading: bool
) -> list[Place]:
    """Place the panels of a row that are side by side, from number ``first`` on."""
    space, panels = layout(), row.panels[first : first + columns]
    left_in = row.left_in or max(map(_left_in, row.panels))
    further_in = space.gap_in if row.common == "xy" else left_in
    room_in = space.width_in - right_in - left_in - (columns - 1) * further_in
    share_in = room_in / columns
    width_in = min(share_in, row.widest_in)
    height_in = row.height_in * space.scale
    if not has_heading:
        top_in += max(_panel_head_in(panel, width_in, is_first=not first) for panel in panels)
    places = []
    for i, panel in enumerate(panels):
        begin_in, main_in = left_in + i * (share_in + further_in), _main_in(panel, width_in)
        is_last = first + i + columns >= len(row.panels)
        has_x = panel.x.numbers and (is_last or not row.common)
        has_y = panel.y.numbers and (i == 0 or row.common != "xy")
        places.append(Place(panel, Box(begin_in, top_in, main_in, height_in), has_x, has_y))
        if panel.beside is not None:
            main_in += _BESIDE_GAP_IN
            box = Box(begin_in + main_in, top_in, width_in - main_in, height_in)
            places.append(Place(panel.beside, box, has_x, has_y=False, is_beside=True))
    return places


def _panel_head_in(panel: Panel, width_in: float, *, is_first: bool) -> float:
    """Return the height above a panel; none below another one, without title and legend."""
    if not (panel.title or panel.labels or is_first):
        return 0.0
    return _head_in(panel.labels, _main_in(panel, width_in), titled=bool(panel.title))


def _main_in(panel: Panel, width_in: float) -> float:
    """Return the width of a panel without the one beside it."""
    if panel.beside is None:
        return width_in
    return width_in - _BESIDE_IN * layout().beside_scale - _BESIDE_GAP_IN


def _left_in(panel: Panel) -> float:
    """Return the room for label and numbers at the left of a panel."""
    space, texts = layout(), (panel.y.ticks or {}).values()
    label_in = 2 * space.character_in if panel.y.label else 0.0
    longest_in = max(map(len, texts), default=0) * space.character_in
    return max(space.left_in, longest_in + BAR_IN + label_in)


def _head_in(labels: Sequence[str], width_in: float, *, titled: bool = True) -> float:
    """Return the height of title and legend above axes of this width."""
    space = layout()
    title_in = space.above_in if titled or (space.beside_title and labels) else _UNTITLED_IN
    rows = len(legend_rows(labels, width_in))
    return title_in + space.legend_row_in * (max(rows - 1, 0) if space.beside_title else rows)


def legend_rows(labels: Iterable[str], width_in: float) -> list[list[int]]:
    """Return which entries are in each row of a legend, in their order.

    A legend is beside the title, or below it as wide as the figure.
    """
    space = layout()
    room_in = width_in - _TITLE_CHARACTERS * space.character_in
    if not space.beside_title:
        room_in = space.width_in - 2 * space.right_in
    rows, left_in = list[list[int]](), 0.0
    for number, label in enumerate(labels):
        entry_in = space.handle_in + space.character_in * len(_MARKUP.sub("", legend_text(label)))
        if entry_in > left_in:
            rows.append([])
            left_in = room_in
        rows[-1].append(number)
        left_in -= entry_in
    return rows


def legend_text(label: str) -> str:
    """Return a label as legends have it: in papers, that of a bound is shorter."""
    for long, brief in _IN_SHORT if layout().is_paper else ():
        label = label.replace(long, brief)
    return label
