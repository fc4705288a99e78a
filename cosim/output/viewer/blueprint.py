"""The layout of a run's recording: panels, their order, colours.

Entities of the recording, all on the timeline ``t`` (simulated time since the run's epoch):

========================  =================================================================
``about``                 Markdown text about the run (static)
``state/<name>``          x, x_s, x_c of one coordinate (3 scalars)
``error/norm``            bound of ‖e_c‖ from (I1), ‖e_s‖, threshold, ‖e_c‖ (4 scalars)
``error/log10``           decimal logarithms of these and of the certified bound (5 scalars)
``size/log10``            decimal logarithms of ‖x‖ (last of 3 scalars) and of its certified bounds:
                          from x(0), and from the newest event
``input``                 u = K x_c (m scalars)
``event/interval``        t_i − t_{i−1} in seconds, at every transmission
``event/stem``            its stem: 0, interval, NaN
``event/certified``       the certified minimum inter-event time, at the start and the end
``reception/interval``    the same between deliveries that were not forced
``reception/forced``      the same for deliveries forced by the guarantee
``reception/stem``        the stems of both
``drop``                  0 at every lost update
``lateness/<process>``    lateness in microseconds
``clock/<process>``       bound of the error of a process's clock in microseconds
``log``                   text
``picture/…``             the plant, animated (``cosim/output/viewer/pictures/``)
``network/…``             the loop's processes, and packets in flight
``key/…``                 the colours and their meaning
========================  =================================================================
"""

import math
from collections.abc import Mapping, Sequence
from typing import Literal, cast
from uuid import UUID

import rerun as rr
import rerun.blueprint as rrb

from cosim.output import palette
from cosim.output.palette import (
    CERTIFIED,
    CONTROLLER,
    IDENTITY,
    LOST,
    PLANT,
    PROCESSES,
    SENSOR,
    SERIES,
    THRESHOLD,
    Colour,
)
from cosim.output.palette import FORCED as FORCED_COLOUR
from cosim.output.viewer.network_diagram import NetworkDiagram
from cosim.output.viewer.pictures.picture import TIMELINE, Picture, Shape, label, lines, panel

ABOUT = "about"
LOG = "log"
ERROR = "error/norm"
ERROR_LOG10 = "error/log10"
SIZE_LOG10 = "size/log10"
INPUT = "input"
EVENT, EVENT_STEM, EVENT_CERTIFIED = "event/interval", "event/stem", "event/certified"
RECEPTION, FORCED, RECEPTION_STEM = "reception/interval", "reception/forced", "reception/stem"
DROP = "drop"

_PAGE_OF_FEW, _PAGE_OF_MANY, _MANY = 4, 9, 16
_BEFORE, _AFTER = 0.02, 0.06
"""Margins of the time axis, as shares of the run's length."""
_GLOBAL_VIEW = UUID("5c0dca6a-e63f-9cf7-f657-2602590474cc")
"""Id of rerun's view that stores the shared settings of linked views."""


def state_path(name: str) -> str:
    """Return the entity of a state coordinate; its name is escaped."""
    return f"state/{rr.escape_entity_path_part(name)}"


def loop_path(name: str) -> str:
    """Return the entity of a loop, in a recording of several; its name is escaped."""
    return f"loops/{rr.escape_entity_path_part(name)}"


def lateness_path(process: str) -> str:
    """Return the entity of a process's lateness; its name is escaped."""
    return f"lateness/{rr.escape_entity_path_part(process)}"


def clock_path(process: str) -> str:
    """Return the entity of the bound of a clock's error; the process's name is escaped."""
    return f"clock/{rr.escape_entity_path_part(process)}"


def styles(
    state_names: Sequence[str], input_names: Sequence[str], processes: Sequence[str]
) -> dict[str, rr.SeriesLines | rr.SeriesPoints]:
    """Return name, colour and width of every series, by entity; logged once as static data."""
    triple = rr.SeriesLines(
        names=["x plant", "x_s sensor model", "x_c controller model"],
        colors=[PLANT, SENSOR, CONTROLLER],
        widths=[4.5, 1.5, 1.5],
    )
    # Later series are drawn on top: ‖e_c‖ often equals its bound, and stays visible on it.
    errors = ["bound (I1)", "‖e_s‖ sensor", "threshold", "‖e_c‖ controller", "certified"]
    colours = [IDENTITY, SENSOR, THRESHOLD, CONTROLLER, CERTIFIED]
    widths = [3.5, 1.5, 2.0, 1.5, 2.0]
    found: dict[str, rr.SeriesLines | rr.SeriesPoints] = {
        state_path(name): triple for name in state_names
    }
    found[ERROR] = rr.SeriesLines(names=errors[:4], colors=colours[:4], widths=widths[:4])
    found[ERROR_LOG10] = rr.SeriesLines(names=errors, colors=colours, widths=widths)
    found[SIZE_LOG10] = rr.SeriesLines(
        names=["certified from x(0)", "bound, given x at the last event", "‖x‖ plant"],
        colors=[CERTIFIED, CERTIFIED, PLANT],
        widths=[2.0, 1.0, 2.5],
    )
    found[EVENT_CERTIFIED] = rr.SeriesLines(names="certified minimum", colors=CERTIFIED, widths=1.5)
    m = len(input_names)
    found[INPUT] = rr.SeriesLines(
        names=list(input_names),
        colors=[input_colour(i) for i in range(m)],
        # Inputs are often equal: the first ones are wider and stay visible.
        widths=[2.0 + 2.5 * (m - 1 - i) / m for i in range(m)],
    )
    found[EVENT_STEM] = _stem("sent", SENSOR)
    found[EVENT] = _mark("sent", SENSOR, "circle", 4.0)
    found[RECEPTION_STEM] = _stem("received", CONTROLLER)
    found[RECEPTION] = _mark("received", CONTROLLER, "circle", 4.0)
    found[FORCED] = _mark("received (forced)", FORCED_COLOUR, "diamond", 6.0)
    found[DROP] = _mark("lost", LOST, "cross", 5.0)
    return found | {lateness_path(one): line for one, line in _of_processes(processes).items()}


def clock_styles(processes: Sequence[str]) -> dict[str, rr.SeriesLines]:
    """Return name, colour and width of the bounds of the clocks' errors, by entity."""
    return {clock_path(one): line for one, line in _of_processes(processes).items()}


def _of_processes(processes: Sequence[str]) -> dict[str, rr.SeriesLines]:
    return {
        process: rr.SeriesLines(
            names=process,
            colors=PROCESSES.get(process, SERIES[i % len(SERIES)]),
            widths=1.5,
            aggregation_policy="Max",
        )
        for i, process in enumerate(processes)
    }


def _stem(name: str, colour: Colour) -> rr.SeriesLines:
    return rr.SeriesLines(names=name, colors=colour, widths=1.5, aggregation_policy="Off")


def _mark(
    name: str,
    colour: Colour,
    marker: Literal["circle", "cross", "diamond"],
    size: float,
) -> rr.SeriesPoints:
    return rr.SeriesPoints(names=name, colors=colour, markers=marker, marker_sizes=size)


def layout(
    state_names: Sequence[str],
    input_names: Sequence[str],
    processes: Sequence[str],
    horizon_s: float,
    *,
    picture: Picture | None = None,
    diagram: NetworkDiagram | None = None,
    clocks: bool = False,
) -> rrb.Blueprint:
    """Lay out the panels of a run; see :func:`panels`."""
    shown = panels(
        state_names, input_names, processes, picture=picture, diagram=diagram, clocks=clocks
    )
    return over_time(shown, horizon_s)


def over_time(shown: rrb.Container, horizon_s: float) -> rrb.Blueprint:
    """Return the layout of panels that share the time axis of a run."""
    return rrb.Blueprint(
        rrb.Horizontal(shown, _common_time_axis(horizon_s)),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        collapse_panels=True,
    )


def panels(
    state_names: Sequence[str],
    input_names: Sequence[str],
    processes: Sequence[str],
    *,
    picture: Picture | None = None,
    diagram: NetworkDiagram | None = None,
    clocks: bool = False,
) -> rrb.Container:
    """Lay out the panels: picture, packets and texts on the left, curves on the right.

    With ``clocks`` the bounds of the clocks' errors are among the texts. Plots have no legends,
    which would cover data; instead, a panel explains the colours.
    """
    texts = _texts(input_names, lateness=bool(processes), clocks=clocks)
    drawings = [] if picture is None else [panel(picture)]
    drawings += [] if diagram is None else [diagram.panel()]
    if drawings:
        left = rrb.Vertical(*drawings, texts, row_shares=[*[4, 3][: len(drawings)], 3.6])
        curves = rrb.Vertical(
            _states(state_names),
            rrb.Horizontal(_norms(), _inputs()),
            _intervals(),
            row_shares=[2, 1, 1],
        )
        return rrb.Horizontal(left, curves, column_shares=[1, 1])
    return rrb.Horizontal(
        rrb.Vertical(_states(state_names), _intervals(), row_shares=[2, 1]),
        rrb.Vertical(_norms(), _inputs(), texts),
        column_shares=[2, 1],
    )


def below(shown: rrb.Container | rrb.View, folder: str) -> None:
    """Let panels show the entities below a folder instead of those at the root."""
    if isinstance(shown, rrb.View):
        shown.origin = f"{folder}/{shown.origin}"
        given = shown.contents
        paths = [given] if isinstance(given, str) else [*cast(Sequence[str], given)]
        shown.contents = [one if one.startswith("$") else f"/{folder}{one}" for one in paths]
        overrides = shown.visualizer_overrides
        shown.visualizer_overrides = {f"{folder}/{path}": one for path, one in overrides.items()}
        return
    for part in shown.contents:
        if isinstance(part, (rrb.Container, rrb.View)):
            below(part, folder)


def _intervals() -> rrb.Container:
    sent = [EVENT_STEM, EVENT, DROP, EVENT_CERTIFIED]
    received = [RECEPTION_STEM, RECEPTION, FORCED, DROP]
    return rrb.Horizontal(
        plot("Broadcasting intervals [s]", "event", sent),
        plot("Receiving intervals [s]", "reception", received),
    )


def _norms() -> rrb.Container:
    return rrb.Tabs(
        plot("log10 ‖e‖", ERROR_LOG10), plot("‖e‖", ERROR), plot("log10 ‖x‖", SIZE_LOG10)
    )


def _inputs() -> rrb.View:
    return plot("Control input u", INPUT)


def _texts(input_names: Sequence[str], *, lateness: bool, clocks: bool) -> rrb.Container:
    """Return the tabs: the colour key, the text about the run, lateness, clocks, the log."""
    return rrb.Tabs(
        ColourKey(input_names).panel(),
        rrb.TextDocumentView(origin=ABOUT, name="About this run"),
        *([plot("Lateness [µs]", "lateness", ["$origin/**"])] if lateness else []),
        *([plot("Clock error [µs]", "clock", ["$origin/**"])] if clocks else []),
        log_view(),
    )


def log_view() -> rrb.View:
    """Return the panel of the run's log."""
    return rrb.TextLogView(
        origin=LOG,
        name="Log",
        # The column of times would be too narrow: the text contains the time.
        columns=rrb.TextLogColumns(
            timeline_columns=rrb.encodings.TimelineColumn(TIMELINE, visible=False),
            text_log_columns=["loglevel", "body"],
        ),
        format_options=rrb.TextLogFormat(monospace_body=True),
    )


def _states(names: Sequence[str]) -> rrb.Container:
    """Return one panel per coordinate: up to four together, more in tabs of equal size."""
    most = _PAGE_OF_FEW if len(names) <= _MANY else _PAGE_OF_MANY
    size = math.ceil(len(names) / math.ceil(len(names) / most))
    pages = [names[i : i + size] for i in range(0, len(names), size)]
    return _page(pages[0]) if len(pages) == 1 else rrb.Tabs(*map(_page, pages))


def _page(names: Sequence[str]) -> rrb.Container:
    title = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]}"
    crowded = len(names) > _PAGE_OF_FEW
    panels = [plot(f"State {name}", state_path(name)) for name in names]
    if len(panels) < _PAGE_OF_FEW:
        return rrb.Vertical(*panels, name=title)
    return rrb.Grid(*panels, grid_columns=3 if crowded else 2, name=title)


def _common_time_axis(horizon_s: float) -> rrb.View:
    """Set the initial time range of all plots: the whole run, with a margin.

    The viewer stores the common range in a hidden view of its own, identified by its id.
    """
    start, end = (
        rr.TimeRangeBoundary.absolute(seconds=share * horizon_s) for share in (-_BEFORE, 1 + _AFTER)
    )
    whole_run = rr.TimeRange(start=start, end=end)
    view = rrb.TimeSeriesView(visible=False, axis_x=rrb.TimeAxis(view_range=whole_run))
    view.id = _GLOBAL_VIEW
    return view


def plot(name: str, origin: str, contents: Sequence[str] = ("$origin",)) -> rrb.TimeSeriesView:
    """Return a time series; all share the time axis and zoom together."""
    return rrb.TimeSeriesView(
        origin=origin,
        contents=[path if path.startswith("$") else f"/{path}" for path in contents],
        name=name,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend(visible=False),
    )


COLOUR_KEY = "key"
"""Parent of all entities of the key."""

_WIDE, _HIGH = 18.0, 1.2
_MOST_IN_A_ROW = 6
_HALF, _THICK = 0.7, 0.16
_DIAMOND = ((0.0, 0.3), (0.2, 0.1), (0.0, -0.1), (-0.2, 0.1), (0.0, 0.3))
_CROSS = ((-0.16, 0.26), (0.16, -0.06), (0.0, 0.1), (0.16, 0.26), (-0.16, -0.06))
_STROKE = ((-_HALF, 0.0), (_HALF, 0.0))
_Entry = tuple[str, palette.Colour, Sequence[tuple[float, float]]]
"""Name, colour, and line of the sample."""
_ROWS: tuple[tuple[_Entry, ...], ...] = (
    (
        ("plant: x", palette.PLANT, _STROKE),
        ("sensor: x_s, ‖e_s‖, sent", palette.SENSOR, _STROKE),
        ("controller: x_c, ‖e_c‖, received", palette.CONTROLLER, _STROKE),
    ),
    (
        ("threshold", palette.THRESHOLD, _STROKE),
        ("bound from (I1)", palette.IDENTITY, _STROKE),
        ("certified bound", palette.CERTIFIED, _STROKE),
    ),
    (
        ("lost", palette.LOST, _CROSS),
        ("delivery forced", palette.FORCED, _DIAMOND),
        ("network", palette.NETWORK, _STROKE),
    ),
)


def input_colour(i: int) -> palette.Colour:
    """Return the colour of the i-th control input."""
    return palette.SERIES[i % len(palette.SERIES)]


class ColourKey:
    """Samples of lines and marks, with their names.

    Args:
        input_names: names of the control inputs; a single input needs no entry.
    """

    def __init__(self, input_names: Sequence[str]) -> None:
        names = input_names if len(input_names) > 1 else ()
        inputs = [(name, input_colour(i), _STROKE) for i, name in enumerate(names)]
        self._rows = [
            *_ROWS,
            *(inputs[i : i + _MOST_IN_A_ROW] for i in range(0, len(inputs), _MOST_IN_A_ROW)),
        ]

    def panel(self) -> rrb.Spatial2DView:
        """The view of the key."""
        return rrb.Spatial2DView(
            origin=COLOUR_KEY,
            name="Colours",
            visual_bounds=rrb.VisualBounds2D(
                x_range=[0.0, _WIDE], y_range=[-0.4, len(self._rows) * _HIGH]
            ),
        )

    def scenery(self) -> Mapping[str, Shape]:
        """The samples and names, by entity."""
        found: dict[str, Shape] = {}
        for i, row in enumerate(self._rows):
            for j, (name, colour, sample) in enumerate(row):
                x, y = (j + 0.5) * _WIDE / len(row), -i * _HIGH
                moved = [(x + dx, y + dy) for dx, dy in sample]
                found[f"{i}/{j}/sample"] = lines([moved], colour, _THICK)
                found[f"{i}/{j}/name"] = label(name, (x, y - 0.2), colour)
        return found
