"""The recording of a run of loops that share a network: all of them together, some in detail.

Entities besides those of the loops, which are below ``loops/NAME`` (:mod:`blueprint`):

=================  ==========================================================================
``about``          Markdown text about the run (static)
``log``            the log of the run, and that of each loop
``link/queue``     datagrams in the network: largest, mean (2 scalars)
``link/share``     share of the link in %, of each loop or quantiles over the loops
``all/error``      decimal logarithm of ‖e_c‖, of each loop or quantiles over the loops
``all/size``       the same of ‖x‖
``all/map``        ‖e_c‖ of each loop, a row, over time, as colours
=================  ==========================================================================

Up to ``PICTURED`` loops are all shown; of more, the worst one only, in the recording of a run that
has ended.
"""

import errno
import math
import os
import secrets
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from shutil import disk_usage
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps
from matplotlib.image import imsave
from numpy.typing import NDArray

from cosim.analysis.network_summary import (
    QUANTILES,
    LoopOverTime,
    LoopsOverTime,
    WorstLoop,
    loops_over_time,
    quantiles,
    worst_loop,
)
from cosim.analysis.summary_model import RunSummary
from cosim.analysis.value_reduction import Reals, is_long
from cosim.output.palette import CONTROLLER, LOST, NETWORK, SERIES
from cosim.output.viewer import blueprint as bp
from cosim.output.viewer.live_viewer import LiveView
from cosim.output.viewer.network_diagram import NetworkDiagram
from cosim.output.viewer.pictures.picture import panel, picture_of
from cosim.output.viewer.recording import (
    LoopView,
    Nanoseconds,
    RecordingFile,
    RunView,
    ViewError,
    about,
)
from cosim.output.viewer.table_feed import ViewFeed, log_level
from cosim.record.run_directory import RECORDING_FILE, Kind, file_of_loop
from cosim.record.run_record import RecordedRun, RunRecord
from noack.config.resolution import loop_of, resolved_loops
from noack.config.scenario import Scenario, loop_names, phases_ns
from noack.core.clock import NS_PER_S
from noack.protocol.topology import LOOP_ROLES

PICTURED = 12
"""Up to so many loops are shown one by one, with their pictures."""
_ANIMATED = 4
"""Up to so many loops have a diagram of their packets, which is most of a recording."""
QUEUE, SHARE, ERROR, SIZE, MAP = "link/queue", "link/share", "all/error", "all/size", "all/map"
_DECADES = 5
_RANGE = 100.0
"""Errors above the usual largest one by this factor have the same colour: a loop may diverge."""
_ROW_PIXELS = 600
"""Least height of the map in pixels."""


class NetworkRecording(RecordingFile):
    """Writes the recording.

    Args:
        run: the scenario of the run.
        run_dir: its directory.
        run_id: its identity.
        shown: the loops that are shown in detail, by their numbers: resolved scenarios.
        worst: the worst loop; None in a run that goes on.
        kind: live or simulated.
        live: live viewer, which shows the file while it is written.

    Raises:
        ViewError: the file cannot be created.
    """

    def __init__(
        self,
        run: Scenario,
        run_dir: Path,
        run_id: int,
        shown: Mapping[int, Scenario],
        *,
        worst: WorstLoop | None,
        kind: Kind,
        live: LiveView | None = None,
    ) -> None:
        self.names = loop_names(run)
        animated = len(shown) <= _ANIMATED and not is_long(run)
        pages = {
            number: _LoopPage(self.names[number], loop, animated=animated)
            for number, loop in shown.items()
        }
        layout = bp.over_time(_layout([*pages.values()], len(self.names), worst), run.horizon_s)
        path, indexed = run_dir / RECORDING_FILE, live is None
        super().__init__(path, f"{run_id:016x}", layout, indexed=indexed)
        self._live, self._usual = live, float(np.finfo(float).tiny)
        self._describe(run, worst)
        phases = phases_ns(run)
        self.views = {
            number: LoopView(
                self, page.name, phases[number], about=about(shown[number], kind),
                state_names=page.loop.state_names, input_names=page.loop.input_names,
                picture=page.picture, diagram=page.diagram,
            )
            for number, page in pages.items()
        }  # fmt: skip
        """The views of the shown loops, by their numbers."""
        if live is not None:
            live.show(path)

    def _describe(self, run: Scenario, worst: WorstLoop | None) -> None:
        """Write the static data of what all loops share."""
        named = (
            "" if worst is None else f"Worst loop: **{self.names[worst.number]}** ({worst.why})."
        )
        text = f"""# {run.name}

{run.description}

{len(self.names)} loops on one network. {named}

Curves of more than {len(SERIES)} loops are quantiles over the loops:
{", ".join(f"{100 * q:g} %" for q in QUANTILES)}.
Curves of norms are cut off at 10^±{_DECADES} times the usual largest value, so that a loop that
diverges does not hide the others. In the map, each row is a loop, the first at the top; time goes
to the right.
"""
        queue = rr.SeriesLines(names=["largest", "mean"], colors=[LOST, NETWORK], widths=[1.0, 2.0])
        self.describe(
            f"{run.name} ({len(self.names)} loops)",
            {
                bp.ABOUT: rr.TextDocument(text, media_type="text/markdown"),
                QUEUE: queue,
                **dict.fromkeys((SHARE, ERROR, SIZE), _series(self.names)),
            },
        )

    def queue(self, t_ns: Nanoseconds, largest: NDArray[Any], mean: Reals) -> None:
        """Add the numbers of datagrams in the network, (k,)."""
        self.send(QUEUE, t_ns, np.column_stack([largest, mean]))

    def share(self, t_ns: Nanoseconds, shares: Reals) -> None:
        """Add the share of the link of each loop, (L, k)."""
        self.send(SHARE, t_ns, 100 * _reduced(shares).T)

    def norms(self, entity: str, t_ns: Nanoseconds, values: Reals) -> None:
        """Add norms of each loop, (L, k), to ``ERROR`` or ``SIZE``.

        Their logarithm is cut off some decades from the usual largest value so far: a norm may be
        0, and a loop that diverges would hide the others.
        """
        curves = _reduced(values)
        self._usual = max(self._usual, usual_largest(curves))
        least, most = self._usual / 10**_DECADES, self._usual * 10**_DECADES
        self.send(entity, t_ns, np.log10(np.clip(curves, least, most)).T)

    def map(self, errors: Reals, t_ns: int | None = None) -> None:
        """Show ‖e_c‖ of each loop, (L, k), from a time on; None: at all times."""
        image = BytesIO()
        imsave(image, map_pixels(errors), format="png", pil_kwargs={"compress_level": 1})
        png, kind = image.getvalue(), "image/png"
        if t_ns is None:
            self.add_static({MAP: rr.EncodedImage(contents=png, media_type=kind)})
            return
        columns = rr.EncodedImage.columns(blob=[png], media_type=[kind])
        self.send_columns(MAP, np.array([t_ns]), columns)

    def close(self) -> None:
        """Write the waiting data and the file's footer; a second call does nothing."""
        try:
            for view in self.views.values():
                view.close()
        finally:
            super().close()
            if self._live is not None:
                self._live.finish()
                self._live = None


class _LoopPage:
    """What the panels of a loop show."""

    def __init__(self, name: str, scenario: Scenario, *, animated: bool) -> None:
        self.name = name
        self.loop = loop_of(scenario)
        self.picture = picture_of(scenario)
        self.diagram = NetworkDiagram(*scenario.network.flows[1:]) if animated else None

    def panels(self) -> rrb.Container:
        """Return the panels of the loop alone."""
        names = (self.loop.state_names, self.loop.input_names, ())
        found = bp.panels(*names, picture=self.picture, diagram=self.diagram)
        bp.below(found, bp.loop_path(self.name))
        found.name = self.name
        return found

    def pictured(self) -> rrb.View:
        """Return the panel of the loop's picture, without the legend: the panel is small."""
        view = panel(self.picture)
        bp.below(view, bp.loop_path(self.name))
        view.contents = ["$origin/**", "- $origin/legend/**"]
        view.name = self.name
        return view


def _layout(pages: Sequence[_LoopPage], count: int, worst: WorstLoop | None) -> rrb.Container:
    """Lay out a page of all ``count`` loops, and one for each that is shown."""
    kind = "" if count <= len(SERIES) else ", quantiles over the loops"
    plots = [
        bp.plot(f"log10 ‖e_c‖{kind}", ERROR),
        bp.plot("Datagrams in the network", QUEUE),
        bp.plot(f"Share of the link [%]{kind}", SHARE),
    ]
    of_map = rrb.Spatial2DView(origin=MAP, name="log10 ‖e_c‖ of each loop, a row, over time")
    left: rrb.Container
    if count <= PICTURED:
        left = rrb.Grid(
            *(page.pictured() for page in pages), grid_columns=math.ceil(math.sqrt(count))
        )
    else:
        left = rrb.Vertical(of_map, bp.plot(f"log10 ‖x‖{kind}", SIZE), row_shares=[2, 1])
    text = rrb.TextDocumentView(origin=bp.ABOUT, name="About this run")
    everything = rrb.Horizontal(left, rrb.Vertical(*plots), name="all loops")
    own = [page.panels() for page in pages]
    if len(own) == 1 < count and worst is not None:
        own[0].name = f"worst loop: {pages[0].name}"
    return rrb.Tabs(everything, *own, bp.log_view(), text, active_tab=0)


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


def usual_largest(curves: Reals) -> float:
    """Return the median over curves (L, k) of their largest values; a tiny number if unknown."""
    largest = np.where(np.isfinite(curves), curves, 0.0).max(axis=1, initial=0.0)
    return float(np.median(largest[largest > 0])) if largest.any() else np.finfo(float).tiny


def map_pixels(errors: Reals) -> NDArray[np.uint8]:
    """Return the colours of norms (L, k), with rows as high as needed; black where unknown."""
    known = np.isfinite(errors)
    levels = np.log10(np.where(known, np.maximum(errors, np.finfo(float).tiny), 1.0))
    most = min(levels[known].max(initial=-np.inf), np.log10(_RANGE * usual_largest(errors)))
    share = np.clip(1 + (levels - most) / _DECADES, 0, 1) if known.any() else levels
    pixels = colormaps["viridis"](share, bytes=True)[..., :3]
    pixels[~known] = 0
    high = max(_ROW_PIXELS // len(errors), 1)
    wide = max(2 * _ROW_PIXELS // errors.shape[1], 1)
    return np.asarray(pixels.repeat(high, axis=0).repeat(wide, axis=1), np.uint8)


_INDEXED_S = 120.0
"""Recordings of runs up to this wall time get an index, which needs memory."""

_SPARE_BYTES = 4 * 2**20
"""Free space without which no recording is written from a record."""


def open_view(
    scenario: Scenario, run_dir: Path, run_id: int, live: LiveView | None
) -> RunView | NetworkRecording:
    """Create the recording of a run, which is written while the run goes on."""
    loops = resolved_loops(scenario)
    if len(loops) > 1:
        shown = dict(enumerate(loops)) if len(loops) <= PICTURED else {}
        return NetworkRecording(
            scenario, run_dir, run_id, shown, worst=None, kind="live", live=live
        )
    return loop_view(loops[0], run_dir / RECORDING_FILE, run_id, live)


def loop_view(
    scenario: Scenario,
    path: Path,
    run_id: int,
    live: LiveView | None = None,
    kind: Kind = "live",
    *,
    at_once: bool = False,
) -> RunView:
    """Create the recording of one loop; it is written afterwards, at once or during the run."""
    loop = loop_of(scenario)
    return RunView(
        path,
        run_id=f"{run_id:016x}",
        title=f"{scenario.name} ({scenario.mode})",
        about=about(scenario, kind),
        state_names=loop.state_names,
        input_names=loop.input_names,
        processes=LOOP_ROLES if kind == "live" else (),
        horizon_s=scenario.horizon_s,
        picture=picture_of(scenario),
        diagram=None
        if at_once and is_long(scenario)
        else NetworkDiagram(*scenario.network.flows[1:]),
        live=live,
        clocks=scenario.clocks is not None and kind == "live",
        indexed=at_once or scenario.horizon_s <= _INDEXED_S * scenario.speed,
    )


def write_view(
    run: RecordedRun,
    summary: RunSummary,
    run_dir: Path,
    loop: str | None,
    known: Sequence[LoopOverTime] | None = None,
) -> None:
    """Write the recording of a run, or of one of its loops, from its record and its summary.

    ``known`` is how each loop of the run went, if that is known.

    Raises:
        ViewError: the recording cannot be written.
    """
    require_space(run_dir)
    run_id = secrets.randbits(64)  # the viewer knows recordings by it
    if loop is None and len(run.loops) > 1:
        _write_network_view(run, summary, run_dir, run_id, loops_over_time(run, known))
        return
    write_loop_view(run.loop(loop), run_dir / file_of_loop(RECORDING_FILE, loop), run_id)


def write_loop_view(record: RunRecord, path: Path, run_id: int) -> None:
    """Write the recording of one loop; that of a long run shows extremes only."""
    require_space(path.parent)
    with loop_view(record.scenario, path, run_id, None, record.kind, at_once=True) as view:
        _feed_record(record, view, path.parent)


def _write_network_view(
    run: RecordedRun, summary: RunSummary, run_dir: Path, run_id: int, over_time: LoopsOverTime
) -> None:
    worst = worst_loop(summary.loops)
    few = len(run.loops) <= PICTURED
    records = {
        number: run.loops[number] for number in (range(len(run.loops)) if few else [worst.number])
    }
    loops = {number: record.scenario for number, record in records.items()}
    with NetworkRecording(
        run.scenario, run_dir, run_id, loops, worst=worst, kind=run.kind
    ) as whole:
        flying = summary.network.in_flight
        largest = np.array(flying.max_by_interval, np.float64)
        queue_ns = (np.arange(len(largest)) + 0.5) * flying.width_s * NS_PER_S
        whole.queue(queue_ns.astype(np.int64), largest, np.array(flying.mean_by_interval))
        middles_ns = (over_time.middles_s * NS_PER_S).astype(np.int64)
        whole.norms(ERROR, middles_ns, over_time.errors)
        whole.norms(SIZE, middles_ns, over_time.states)
        whole.map(over_time.errors)
        ends_s, shares = over_time.shares()
        whole.share(((ends_s - ends_s[0] / 2) * NS_PER_S).astype(np.int64), shares)
        for notice in run.network.notices:
            whole.log(int(notice["t_ns"]), log_level(notice), str(notice["text"]))
        for number, record in records.items():
            _feed_record(record, whole.views[number], run_dir)


def _feed_record(record: RunRecord, view: RunView, run_dir: Path) -> None:
    """Pass a record to a view, part by part, while there is space in its folder."""
    columns = record.slice_columns if is_long(record.scenario) else None
    feed = ViewFeed(record.scenario, view, columns)
    for i, part in enumerate(record.slices()):
        require_space(run_dir)
        if i:
            feed.advance()
        for table, rows in part.items():
            feed.add(table, rows)
    for notice in record.notices:
        feed.log(notice)
    feed.advance(final=True)


def require_space(run_dir: Path) -> None:
    """Raise ViewError if the disk is nearly full: rerun may wait forever after a failed write."""
    if disk_usage(run_dir).free < _SPARE_BYTES:
        path = run_dir / RECORDING_FILE
        raise ViewError(f"{path}: cannot write the recording: {os.strerror(errno.ENOSPC)}")
