"""The recording of a run of several loops, written at its end.

Entities besides those of the loops, which are below ``loops/NAME`` (:mod:`blueprint`):

=================  ==========================================================================
``about``          Markdown text about the run (static)
``link/queue``     datagrams in the network: largest, mean (2 scalars)
``link/share``     share of the link in %, of each loop or quantiles over the loops
``all/error``      decimal logarithm of ‖e_c‖, of each loop or quantiles over the loops
``all/size``       the same of ‖x‖
``all/map``        ‖e_c‖ of each loop, a row, over time, as colours (static)
=================  ==========================================================================

Up to ``PICTURED`` loops are all shown; of more, the worst one only.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps
from numpy.typing import NDArray

from cosim.analysis.loops_over_time import (
    QUANTILES,
    LoopsOverTime,
    WorstLoop,
    loops_over_time,
    quantiles,
    worst_loop,
)
from cosim.output.palette import CONTROLLER, LOST, NETWORK, SERIES
from cosim.output.viewer import blueprint as bp
from cosim.output.viewer.pictures.network_picture import NetworkDiagram
from cosim.output.viewer.pictures.picture import panel
from cosim.output.viewer.pictures.picture_choice import picture_of
from cosim.output.viewer.recording import LoopView
from cosim.output.viewer.recording_file import RecordingFile
from cosim.output.viewer.run_view import about, feed_record, require_space
from cosim.output.viewer.table_feed import ViewFeed
from cosim.record.decimate import Reals, is_long
from cosim.record.loops_run import loop_directories
from cosim.record.run_directory import RECORDING_FILE
from cosim.record.run_record import RunRecord, load_record
from noack.config.loops import phases_ns
from noack.config.resolution import loop_of
from noack.core.clock import NS_PER_S

PICTURED = 12
"""Up to so many loops are shown one by one, with their pictures."""
_ANIMATED = 4
"""Up to so many loops have a diagram of their packets, which is most of a recording."""
QUEUE, SHARE, ERROR, SIZE, MAP = "link/queue", "link/share", "all/error", "all/size", "all/map"
_DECADES = 5
_ROW_PIXELS = 600
"""Least height of the map in pixels."""


def write_loops_view(
    network: RunRecord, summary: Mapping[str, Any], run_dir: Path, run_id: int
) -> None:
    """Write the recording of a run of several loops, from its records and its summary.

    Raises:
        ViewError: the recording cannot be written.
    """
    require_space(run_dir)
    directories = loop_directories(run_dir, network.scenario)
    over_time = loops_over_time(network, map(load_record, directories))
    names = [directory.name for directory in directories]
    worst = worst_loop(run_dir, summary["loops"])
    shown = range(len(names)) if len(names) <= PICTURED else [worst.number]
    records = {number: load_record(directories[number]) for number in shown}
    animated = len(records) <= _ANIMATED and not is_long(network.scenario)
    pages = {
        names[number]: _LoopPage(record, animated=animated) for number, record in records.items()
    }
    layout = bp.over_time(_layout(pages, names, worst), network.scenario.horizon_s)
    path = run_dir / RECORDING_FILE
    with RecordingFile(path, f"{run_id:016x}", layout, indexed=True) as whole:
        _send_all(whole, network, summary, over_time, worst)
        phases = phases_ns(network.scenario)
        for number, record in records.items():
            page = pages[names[number]]
            with LoopView(
                whole, names[number], phases[number], about=about(record.scenario, record.kind),
                state_names=page.loop.state_names, input_names=page.loop.input_names,
                picture=page.picture, diagram=page.diagram,
            ) as view:  # fmt: skip
                columns = record.slice_columns if is_long(record.scenario) else None
                feed_record(ViewFeed(record.scenario, view, columns), record, run_dir)


class _LoopPage:
    """What the panels of a loop show."""

    def __init__(self, record: RunRecord, *, animated: bool) -> None:
        scenario = record.scenario
        self.loop = loop_of(scenario)
        self.picture = picture_of(scenario)
        self.diagram = NetworkDiagram(*scenario.network.flows[1:]) if animated else None

    def panels(self, name: str) -> rrb.Container:
        """Return the panels of the loop alone."""
        names = (self.loop.state_names, self.loop.input_names, ())
        found = bp.panels(*names, picture=self.picture, diagram=self.diagram)
        bp.below(found, bp.loop_path(name))
        found.name = name
        return found

    def pictured(self, name: str) -> rrb.View:
        """Return the panel of the loop's picture, without the legend: the panel is small."""
        view = panel(self.picture)
        bp.below(view, bp.loop_path(name))
        view.contents = ["$origin/**", "- $origin/legend/**"]
        view.name = name
        return view


def _layout(
    pages: Mapping[str, _LoopPage], names: Sequence[str], worst: WorstLoop
) -> rrb.Container:
    """Lay out a page of all loops, and one for each that is shown."""
    kind = "" if len(names) <= len(SERIES) else ", quantiles over the loops"
    plots = [
        bp.plot(f"log10 ‖e_c‖{kind}", ERROR),
        bp.plot("Datagrams in the network", QUEUE),
        bp.plot(f"Share of the link [%]{kind}", SHARE),
    ]
    of_map = rrb.Spatial2DView(origin=MAP, name="log10 ‖e_c‖ of each loop, a row, over time")
    left: rrb.Container
    if len(names) <= PICTURED:
        left = rrb.Grid(*(page.pictured(name) for name, page in pages.items()))
    else:
        left = rrb.Vertical(of_map, bp.plot(f"log10 ‖x‖{kind}", SIZE), row_shares=[2, 1])
    text = rrb.TextDocumentView(origin=bp.ABOUT, name="About this run")
    everything = rrb.Horizontal(left, rrb.Vertical(*plots), name="all loops")
    own = [page.panels(name) for name, page in pages.items()]
    if len(own) == 1 < len(names):
        own[0].name = f"worst loop: {names[worst.number]}"
    return rrb.Tabs(everything, *own, text, active_tab=0)


def _send_all(
    whole: RecordingFile,
    network: RunRecord,
    summary: Mapping[str, Any],
    over_time: LoopsOverTime,
    worst: WorstLoop,
) -> None:
    """Write what the page of all loops shows."""
    scenario = network.scenario
    names = [loop["name"] for loop in summary["loops"]]
    text = f"""# {scenario.name}

{scenario.description}

{len(names)} loops on one network. Worst loop: **{names[worst.number]}** ({worst.why}).

Curves of more than {len(SERIES)} loops are quantiles over the loops:
{", ".join(f"{100 * q:g} %" for q in QUANTILES)}.
"""
    series = _series(names)
    whole.describe(
        f"{scenario.name} ({len(names)} loops)",
        {
            bp.ABOUT: rr.TextDocument(text, media_type="text/markdown"),
            QUEUE: rr.SeriesLines(
                names=["largest", "mean"], colors=[LOST, NETWORK], widths=[1.0, 2.0]
            ),
            **dict.fromkeys((SHARE, ERROR, SIZE), series),
            MAP: rr.Image(map_pixels(over_time.errors)),
        },
    )
    flying = summary["network"]["in_flight"]
    counts = np.array([flying["max_by_interval"], flying["mean_by_interval"]], dtype=np.float64)
    width_ns = flying["width_s"] * NS_PER_S
    queue_ns = ((np.arange(counts.shape[1]) + 0.5) * width_ns).astype(np.int64)
    whole.send(QUEUE, queue_ns, counts.T)
    middles_ns = (over_time.middles_s * NS_PER_S).astype(np.int64)
    for entity, values in ((ERROR, over_time.errors), (SIZE, over_time.states)):
        whole.send(entity, middles_ns, _levels(_reduced(values)).T)
    ends_s, shares = over_time.shares()
    ends_ns = ((ends_s - ends_s[0] / 2) * NS_PER_S).astype(np.int64)
    whole.send(SHARE, ends_ns, 100 * _reduced(shares).T)


def _series(names: Sequence[str]) -> rr.SeriesLines:
    if len(names) <= len(SERIES):
        return rr.SeriesLines(names=list(names), colors=list(SERIES[: len(names)]))
    labels = [f"{100 * q:g} % of the loops" for q in QUANTILES[:-1]] + ["largest"]
    widths = [1.0, 1.5, 3.0, 1.5, 1.0, 1.0]
    colours = [CONTROLLER] * (len(QUANTILES) - 1) + [LOST]
    return rr.SeriesLines(names=labels, colors=colours, widths=widths)


def _reduced(values: Reals) -> Reals:
    """Return the curves to show, (curves, k): each loop's, or quantiles over many loops."""
    return values if len(values) <= len(SERIES) else quantiles(values)


def _levels(curves: Reals) -> Reals:
    """Return log10 of curves, cut off some decades below the largest value: a norm may be 0."""
    most = float(np.nanmax(curves, initial=np.finfo(float).tiny))
    return np.asarray(np.log10(np.maximum(curves, most / 10**_DECADES)))


def map_pixels(errors: Reals) -> NDArray[np.uint8]:
    """Return the colours of norms (L, k), with rows as high as needed; black where unknown."""
    known = np.isfinite(errors)
    levels = np.log10(np.where(known, np.maximum(errors, np.finfo(float).tiny), 1.0))
    most = levels[known].max(initial=-np.inf)
    share = np.clip(1 + (levels - most) / _DECADES, 0, 1) if known.any() else levels
    pixels = colormaps["viridis"](share, bytes=True)[..., :3]
    pixels[~known] = 0
    high = max(_ROW_PIXELS // len(errors), 1)
    wide = max(2 * _ROW_PIXELS // errors.shape[1], 1)
    return np.asarray(pixels.repeat(high, axis=0).repeat(wide, axis=1), np.uint8)
