"""The layout of a run's recording: panels, their order, colours.

Entities of the recording, all on the timeline ``t`` (simulated time since the run's epoch):

========================  =================================================================
``about``                 Markdown text about the run (static)
``state/<name>``          x, x_s, x_c of one coordinate (3 scalars)
``error/norm``            bound of ‖e_c‖ from (I1), ‖e_s‖, threshold, ‖e_c‖ (4 scalars)
``error/log10``           decimal logarithms of these and of the certified bound (5 scalars)
``size/log10``            decimal logarithms of the certified bound of ‖x‖, and of ‖x‖ (2 scalars)
``output/<name>``         decimal logarithms of an output that the scenario states: its certified bound,
                          its allowed error, its distance from what it follows (3 scalars)
``input``                 u = K x_c (m scalars)
``event/interval``        t_i − t_{i−1} in seconds, at every transmission
``event/stem``            its stem: 0, interval, NaN
``event/certified``       the certified minimum inter-event time, at the start and the end
``reception/interval``    the same between deliveries that were not forced
``reception/forced``      the same for deliveries forced by the guarantee
``reception/stem``        the stems of both
``drop``                  0 at every lost update
``lateness/<process>``    lateness in microseconds
``log``                   text
``picture/…``             the plant, animated (``cosim/output/viewer/pictures/``)
``network/…``             the loop's processes, and packets in flight
``key/…``                 the colours and their meaning
========================  =================================================================
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, cast
from uuid import UUID

import rerun as rr
import rerun.blueprint as rrb

from cosim.output.figures import palette
from cosim.output.figures.palette import (
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
from cosim.output.viewer.network_diagram import DIAGRAM, NetworkDiagram
from cosim.output.viewer.pictures.picture import PICTURE, TIMELINE, Picture, Shape, label, lines, panel
from noack.core.references import Reference
from noack.scenario.outputs import LoopOutput

Static = rr.TextDocument | rr.SeriesLines | rr.SeriesPoints | Shape
"""Data that do not change during a run."""

ABOUT = "about"
LOG = "log"
ERROR = "error/norm"
ERROR_LOG10 = "error/log10"
SIZE_LOG10 = "size/log10"
INPUT = "input"
EVENT, EVENT_STEM, EVENT_CERTIFIED = "event/interval", "event/stem", "event/certified"
RECEPTION, RECEPTION_FORCED, RECEPTION_STEM = "reception/interval", "reception/forced", "reception/stem"
DROP = "drop"

_FEW_PER_PAGE, _MANY_PER_PAGE, _MOST_FEW_STATES = 4, 9, 16
"""States on a page, of up to :data:`_MOST_FEW_STATES` states and of more."""
_MARGIN_BEFORE, _MARGIN_AFTER = 0.02, 0.06
"""Margins of the time axis, as shares of the run's length."""
_GLOBAL_VIEW = UUID("5c0dca6a-e63f-9cf7-f657-2602590474cc")
"""Id of rerun's view that stores the shared settings of linked views."""


def state_path(name: str) -> str:
    """Return the entity of a state coordinate; its name is escaped."""
    return f"state/{rr.escape_entity_path_part(name)}"


def output_path(name: str) -> str:
    """Return the entity of an output; its name is escaped."""
    return f"output/{rr.escape_entity_path_part(name)}"


def loop_folder(name: str) -> str:
    """Return the folder of a loop's entities, in a recording of several; its name is escaped."""
    return f"loops/{rr.escape_entity_path_part(name)}/"


def lateness_path(process: str) -> str:
    """Return the entity of a process's lateness; its name is escaped."""
    return f"lateness/{rr.escape_entity_path_part(process)}"


@dataclass(frozen=True)
class LoopLayout:
    """What the viewer shows of a loop."""

    about: str
    """Markdown shown beside the plots."""
    state_names: Sequence[str]
    input_names: Sequence[str]
    processes: Sequence[str] = ()
    """Those whose lateness is shown; none in a simulated run."""
    picture: Picture | None = None
    """Picture of the plant, if there is one."""
    diagram: NetworkDiagram | None = None
    """Diagram of the network, if there is one."""
    reference: Reference | None = None
    """The reference at the run's start; None is 0."""
    outputs: Sequence[LoopOutput] = ()
    """The outputs that the scenario states."""
    folder: str = ""
    """Entities of the loop are below it; it ends with a slash, or is empty."""
    phase_ns: int = 0
    """Time of the run at which the loop's own time is 0."""

    def static(self) -> dict[str, Static]:
        """Return what does not move, by entity: texts, styles of series, scenery, colour key."""
        entities: dict[str, Static] = {
            ABOUT: rr.TextDocument(self.about, media_type="text/markdown"),
            **_styles(self),
        }
        drawings = {COLOUR_KEY: colour_key(self.input_names)}
        if self.picture is not None:
            drawings[PICTURE] = self.picture.scenery()
        if self.diagram is not None:
            drawings[DIAGRAM] = self.diagram.scenery()
        for parent, shapes in drawings.items():
            entities |= {f"{parent}/{entity}": shape for entity, shape in shapes.items()}
        return {f"{self.folder}{entity}": shape for entity, shape in entities.items()}

    def panels(self) -> rrb.Container:
        """Lay out the panels: picture, packets and texts on the left, curves on the right.

        Plots have no legends, which would cover data; instead, a panel explains the colours.
        """
        drawings = [] if self.picture is None else [panel(self.picture)]
        drawings += [] if self.diagram is None else [self.diagram.panel()]
        states, texts = _states(self.state_names), _texts(self)
        norms, inputs, intervals = _norms(self.outputs), plot("Control input u", INPUT), _intervals()
        if drawings:
            shares = [*[4, 3][: len(drawings)], 3.6]
            left: rrb.Container = rrb.Vertical(*drawings, texts, row_shares=shares)
            below = rrb.Horizontal(norms, inputs)
            right = rrb.Vertical(states, below, intervals, row_shares=[2, 1, 1])
            container = rrb.Horizontal(left, right, column_shares=[1, 1])
        else:
            left = rrb.Vertical(states, intervals, row_shares=[2, 1])
            right = rrb.Vertical(norms, inputs, texts)
            container = rrb.Horizontal(left, right, column_shares=[2, 1])
        move_below(container, self.folder)
        return container

    def small_picture(self) -> rrb.View:
        """Return the panel of the picture, without its legend: the panel is small."""
        assert self.picture is not None
        view = panel(self.picture)
        move_below(view, self.folder)
        view.contents = ["$origin/**", "- $origin/legend/**"]
        return view


def _styles(layout: LoopLayout) -> dict[str, Static]:
    """Return name, colour and width of every series, by entity."""
    input_names, m = layout.input_names, len(layout.input_names)
    states = 3 if layout.reference is None else 4
    of_state = rr.SeriesLines(
        names=["x plant", "x_s sensor model", "x_c controller model", "x_r reference"][:states],
        colors=[PLANT, SENSOR, CONTROLLER, THRESHOLD][:states],
        widths=[4.5, 1.5, 1.5, 1.0][:states],
    )
    # Later series are drawn on top: ‖e_c‖ often equals its bound, and stays visible on it.
    errors = ["bound (I1)", "‖e_s‖ sensor", "threshold", "‖e_c‖ controller", "certified"]
    colours = [IDENTITY, SENSOR, THRESHOLD, CONTROLLER, CERTIFIED]
    widths = [3.5, 1.5, 2.0, 1.5, 2.0]
    lateness = {lateness_path(process): line for process, line in _process_styles(layout.processes).items()}
    of_output = [
        (output_path(each.name), [f"{each.name}, certified", "allowed error", each.name])
        for each in layout.outputs
    ]
    return {
        **{state_path(name): of_state for name in layout.state_names},
        **{
            path: rr.SeriesLines(names=names, colors=[CERTIFIED, THRESHOLD, PLANT], widths=[2.0, 1.5, 2.5])
            for path, names in of_output
        },
        ERROR: rr.SeriesLines(names=errors[:4], colors=colours[:4], widths=widths[:4]),
        ERROR_LOG10: rr.SeriesLines(names=errors, colors=colours, widths=widths),
        SIZE_LOG10: rr.SeriesLines(
            names=["certified", "‖x‖ plant" if layout.reference is None else "‖x − x_r‖ plant"],
            colors=[CERTIFIED, PLANT],
            widths=[2.0, 2.5],
        ),
        EVENT_CERTIFIED: rr.SeriesLines(names="certified minimum", colors=CERTIFIED, widths=1.5),
        INPUT: rr.SeriesLines(
            names=list(input_names),
            colors=[input_colour(i) for i in range(m)],
            # Inputs are often equal: the first ones are wider and stay visible.
            widths=[2.0 + 2.5 * (m - 1 - i) / m for i in range(m)],
        ),
        EVENT_STEM: _stem("sent", SENSOR),
        EVENT: _mark("sent", SENSOR, "circle", 4.0),
        RECEPTION_STEM: _stem("received", CONTROLLER),
        RECEPTION: _mark("received", CONTROLLER, "circle", 4.0),
        RECEPTION_FORCED: _mark("received (forced)", palette.FORCED, "diamond", 6.0),
        DROP: _mark("lost", LOST, "cross", 5.0),
        **lateness,
    }


def _process_styles(processes: Sequence[str]) -> dict[str, rr.SeriesLines]:
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


def over_time(container: rrb.Container, horizon_s: float) -> rrb.Blueprint:
    """Return the layout of panels that share the time axis of a run."""
    return rrb.Blueprint(
        rrb.Horizontal(container, _common_time_axis(horizon_s)),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        collapse_panels=True,
    )


def move_below(part: rrb.Container | rrb.View, folder: str) -> None:
    """Let panels show the entities below a folder instead of those at the root."""
    if isinstance(part, rrb.View):
        part.origin = f"{folder}{part.origin}"
        contents = part.contents
        paths = [contents] if isinstance(contents, str) else [*cast(Sequence[str], contents)]
        part.contents = [p if p.startswith("$") else f"/{folder}{p.lstrip('/')}" for p in paths]
        overrides = part.visualizer_overrides
        part.visualizer_overrides = {f"{folder}{path}": override for path, override in overrides.items()}
        return
    for inner in part.contents:
        if isinstance(inner, (rrb.Container, rrb.View)):
            move_below(inner, folder)


def _intervals() -> rrb.Container:
    event_entities = [EVENT_STEM, EVENT, DROP, EVENT_CERTIFIED]
    reception_entities = [RECEPTION_STEM, RECEPTION, RECEPTION_FORCED, DROP]
    return rrb.Horizontal(
        plot("Broadcasting intervals [s]", "event", event_entities),
        plot("Receiving intervals [s]", "reception", reception_entities),
    )


def _norms(outputs: Sequence[LoopOutput]) -> rrb.Container:
    of_outputs = [plot(f"log10 |{output.name}|", output_path(output.name)) for output in outputs]
    return rrb.Tabs(
        plot("log10 ‖e‖", ERROR_LOG10), *of_outputs, plot("‖e‖", ERROR), plot("log10 ‖x‖", SIZE_LOG10)
    )


def _texts(layout: LoopLayout) -> rrb.Container:
    """Return the tabs: the colour key, the text about the run, lateness, the log."""
    everything = ["$origin/**"]
    timing = [plot("Lateness [µs]", "lateness", everything)] if layout.processes else []
    key, text = colour_key_panel(layout.input_names), about_view()
    return rrb.Tabs(key, text, *timing, log_view())


def about_view() -> rrb.View:
    """Return the panel of the text about the run."""
    return rrb.TextDocumentView(origin=ABOUT, name="About this run")


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
    per_page = _FEW_PER_PAGE if len(names) <= _MOST_FEW_STATES else _MANY_PER_PAGE
    size = math.ceil(len(names) / math.ceil(len(names) / per_page))
    pages = [names[i : i + size] for i in range(0, len(names), size)]
    return _page(pages[0]) if len(pages) == 1 else rrb.Tabs(*map(_page, pages))


def _page(names: Sequence[str]) -> rrb.Container:
    title = names[0] if len(names) == 1 else f"{names[0]} … {names[-1]}"
    crowded = len(names) > _FEW_PER_PAGE
    panels = [plot(f"State {name}", state_path(name)) for name in names]
    if len(panels) < _FEW_PER_PAGE:
        return rrb.Vertical(*panels, name=title)
    return rrb.Grid(*panels, grid_columns=3 if crowded else 2, name=title)


def _common_time_axis(horizon_s: float) -> rrb.View:
    """Set the initial time range of all plots: the whole run, with a margin.

    The viewer stores the common range in a hidden view of its own, identified by its id.
    """
    start, end = (
        rr.TimeRangeBoundary.absolute(seconds=share * horizon_s)
        for share in (-_MARGIN_BEFORE, 1 + _MARGIN_AFTER)
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

_KEY_WIDTH, _ROW_HEIGHT = 18.0, 1.2
"""Lengths in the key have a unit of their own."""
_ENTRIES_PER_ROW = 6
"""Most inputs in a row of the key."""
_HALF_STROKE, _STROKE_WIDTH = 0.7, 0.16
_DIAMOND = ((0.0, 0.3), (0.2, 0.1), (0.0, -0.1), (-0.2, 0.1), (0.0, 0.3))
_CROSS = ((-0.16, 0.26), (0.16, -0.06), (0.0, 0.1), (0.16, 0.26), (-0.16, -0.06))
_STROKE = ((-_HALF_STROKE, 0.0), (_HALF_STROKE, 0.0))
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


def _key_rows(input_names: Sequence[str]) -> list[Sequence[_Entry]]:
    """Return the rows of the key; a single input needs no entry."""
    names = input_names if len(input_names) > 1 else ()
    inputs = [(name, input_colour(i), _STROKE) for i, name in enumerate(names)]
    size = _ENTRIES_PER_ROW
    return [*_ROWS, *(inputs[i : i + size] for i in range(0, len(inputs), size))]


def colour_key_panel(input_names: Sequence[str]) -> rrb.Spatial2DView:
    """Return the panel that explains the colours."""
    height = len(_key_rows(input_names)) * _ROW_HEIGHT
    bounds = rrb.VisualBounds2D(x_range=[0.0, _KEY_WIDTH], y_range=[-0.4, height])
    return rrb.Spatial2DView(origin=COLOUR_KEY, name="Colours", visual_bounds=bounds)


def colour_key(input_names: Sequence[str]) -> Mapping[str, Shape]:
    """Return samples of lines and marks, with their names, by entity."""
    shapes: dict[str, Shape] = {}
    for i, row in enumerate(_key_rows(input_names)):
        for j, (name, colour, sample) in enumerate(row):
            x, y = (j + 0.5) * _KEY_WIDTH / len(row), -i * _ROW_HEIGHT
            points = [(x + dx, y + dy) for dx, dy in sample]
            shapes[f"{i}/{j}/sample"] = lines([points], colour, _STROKE_WIDTH)
            shapes[f"{i}/{j}/name"] = label(name, (x, y - 0.2), colour)
    return shapes
