"""The recording of a run: its loops in detail and, if there are several, all of them together.

Entities of a loop (:mod:`blueprint`) are below ``loops/NAME``; those of the only loop are at the
root. What is shown of several loops together:

=================  ==========================================================================
``about``          Markdown text about the run (static)
``log``            the log of the run, and that of each loop
``link/queue``     datagrams in the network: largest, mean (2 scalars)
``link/share``     share of the link in %, of each loop or quantiles over the loops
``all/error``      decimal logarithm of ‖e_c‖, of each loop or quantiles over the loops
``all/size``       the same of ‖x‖
``all/map``        ‖e_c‖ of each loop, a row, over time, as colours
=================  ==========================================================================

Up to ``MOST_PICTURED`` loops are all shown; of more, the worst one only, in the recording of a run that
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

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps
from matplotlib.image import imsave
from numpy.typing import NDArray

from cosim.analysis.summary.loops_over_time import (
    QUANTILES,
    LoopOverTime,
    LoopsOverTime,
    loops_over_time,
    quantiles,
)
from cosim.analysis.summary.run_summary import WorstLoop, worst_loop
from cosim.analysis.summary.summary_model import RunSummary
from cosim.output.figures.palette import CONTROLLER, LOST, NETWORK, SERIES
from cosim.output.viewer import blueprint as bp
from cosim.output.viewer.loop_feed import LoopFeed, log_level
from cosim.output.viewer.loop_recording import LoopView, RecordingFile, ViewError, run_text
from cosim.output.viewer.network_diagram import NetworkDiagram
from cosim.output.viewer.pictures.picture import picture_of
from cosim.output.viewer.recording_viewer import LiveView
from cosim.record.align import Reals, Times
from cosim.record.decimation import is_long
from cosim.record.run_directory import RECORDING_FILE, Kind, file_of_loop
from cosim.record.run_record import RecordedRun, RunRecord
from netem.core.clock import NS_PER_S
from noack.protocol.roles import LOOP_ROLES
from noack.scenario.resolution import ResolvedRun, loop_of
from noack.scenario.scenario import Scenario

MOST_PICTURED = 12
"""Largest number of loops that are shown one by one, with their pictures."""
_MOST_ANIMATED = 4
"""Largest number of loops with a diagram of their packets, which is most of a recording."""
QUEUE, SHARE, ALL_ERRORS, ALL_SIZES, MAP = "link/queue", "link/share", "all/error", "all/size", "all/map"
_DECADES = 5
"""Decades of a norm that the curves show to each side of its usual largest value, and the map below."""
_RANGE = 100.0
"""Errors above the usual largest one by this factor have the same colour: a loop may diverge."""
_ROW_PIXELS = 600
"""Least height of the map in pixels."""
_INDEXED_S = 120.0
"""Recordings of runs up to this wall time get an index, which needs memory."""
_SPARE_BYTES = 4 * 2**20
"""Free space without which no recording is written from a record."""


class RunRecording(RecordingFile):
    """Writes the recording of a run.

    Args:
        run: the scenario of the run.
        path: the file; replaced if it exists.
        run_id: identity of the recording, unique among runs.
        shown: the loops that are shown in detail, by their numbers: resolved scenarios.
        kind: live or simulated.
        worst: the worst loop; None in a run that goes on.
        live: live viewer, which shows the file while it is written.
        complete: whether the run has ended: its whole record is written.

    Raises:
        ViewError: the file cannot be created.
    """

    def __init__(
        self,
        run: Scenario,
        path: Path,
        run_id: int,
        shown: Mapping[int, Scenario],
        kind: Kind = "live",
        *,
        worst: WorstLoop | None = None,
        live: LiveView | None = None,
        complete: bool = False,
    ) -> None:
        of_run = ResolvedRun(run)
        self.names, phases = of_run.names, of_run.phases_ns
        self.is_shared = len(self.names) > 1
        animated = len(shown) <= _MOST_ANIMATED and not (complete and is_long(run))
        loops = {
            number: _loop_layout(
                loop,
                kind,
                bp.loop_folder(self.names[number]) if self.is_shared else "",
                phases[number] if self.is_shared else 0,
                animated=animated,
            )
            for number, loop in shown.items()
        }
        panels = {self.names[number]: loop for number, loop in loops.items()}
        container = _tabs(panels, len(self.names), worst) if self.is_shared else loops[0].panels()
        indexed = complete or run.horizon_s <= _INDEXED_S * run.speed
        over_time = bp.over_time(container, run.horizon_s)
        super().__init__(path, f"{run_id:016x}", over_time, indexed=indexed)
        self._live, self._usual = live, float(np.finfo(float).tiny)
        if self.is_shared:
            self._describe(run, worst)
        else:
            self.describe(f"{run.name} ({shown[0].mode})", {})
        self.views = {number: LoopView(self, loop) for number, loop in loops.items()}
        """The views of the shown loops, by their numbers."""
        if live is not None:
            live.show(path)

    def _describe(self, run: Scenario, worst: WorstLoop | None) -> None:
        """Write the static data of what all loops share."""
        worst_text = "" if worst is None else f"Worst loop: **{self.names[worst.number]}** ({worst.why})."
        text = f"""# {run.name}

{run.description}

{len(self.names)} loops on one network. {worst_text}

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
                **dict.fromkeys((SHARE, ALL_ERRORS, ALL_SIZES), _series(self.names)),
            },
        )

    def add_queue(self, t_ns: Times, largest: Reals | NDArray[np.int64], mean: Reals) -> None:
        """Add the numbers of datagrams in the network, (k,)."""
        self.send(QUEUE, t_ns, np.column_stack([largest, mean]))

    def add_shares(self, t_ns: Times, shares: Reals) -> None:
        """Add the share of the link of each loop, (L, k)."""
        self.send(SHARE, t_ns, 100 * _curves_or_quantiles(shares).T)

    def add_norms(self, entity: str, t_ns: Times, values: Reals) -> None:
        """Add norms of each loop, (L, k), to ``ALL_ERRORS`` or ``ALL_SIZES``.

        Their logarithm is cut off some decades from the usual largest value so far: a norm may be
        0, and a loop that diverges would hide the others.
        """
        curves = _curves_or_quantiles(values)
        self._usual = max(self._usual, usual_largest(curves))
        low, high = self._usual / 10**_DECADES, self._usual * 10**_DECADES
        self.send(entity, t_ns, np.log10(np.clip(curves, low, high)).T)

    def add_map(self, errors: Reals, t_ns: int | None = None) -> None:
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
                view.write_frames()
        finally:
            super().close()
            if self._live is not None:
                self._live.finish()
                self._live = None


def _loop_layout(
    scenario: Scenario, kind: Kind, folder: str, phase_ns: int, *, animated: bool
) -> bp.LoopLayout:
    """Describe what is shown of a loop; lateness only if the processes have no other loop."""
    loop, is_timed = loop_of(scenario), kind == "live" and not folder
    return bp.LoopLayout(
        run_text(scenario, kind),
        loop.state_names,
        loop.input_names,
        processes=LOOP_ROLES if is_timed else (),
        picture=picture_of(scenario),
        diagram=NetworkDiagram(*scenario.network.flows[1:]) if animated else None,
        reference=loop.reference,
        outputs=scenario.loop_outputs() if scenario.outputs else (),
        folder=folder,
        phase_ns=phase_ns,
    )


def _tabs(loops: Mapping[str, bp.LoopLayout], count: int, worst: WorstLoop | None) -> rrb.Container:
    """Lay out a page of all ``count`` loops, and one for each that is shown."""
    kind = "" if count <= len(SERIES) else ", quantiles over the loops"
    plots = [
        bp.plot(f"log10 ‖e_c‖{kind}", ALL_ERRORS),
        bp.plot("Datagrams in the network", QUEUE),
        bp.plot(f"Share of the link [%]{kind}", SHARE),
    ]
    pages, pictures_of_loops = list[rrb.Container](), list[rrb.View]()
    for name, loop in loops.items():
        pages.append(loop.panels())
        pages[-1].name = f"worst loop: {name}" if len(loops) == 1 and worst is not None else name
        pictures_of_loops.append(loop.small_picture())
        pictures_of_loops[-1].name = name
    columns = math.ceil(math.sqrt(count))
    pictures: rrb.Container = rrb.Grid(*pictures_of_loops, grid_columns=columns)
    if count > MOST_PICTURED:
        of_map = rrb.Spatial2DView(origin=MAP, name="log10 ‖e_c‖ of each loop, a row, over time")
        pictures = rrb.Vertical(of_map, bp.plot(f"log10 ‖x‖{kind}", ALL_SIZES), row_shares=[2, 1])
    overview = rrb.Horizontal(pictures, rrb.Vertical(*plots), name="all loops")
    return rrb.Tabs(overview, *pages, bp.log_view(), bp.about_view(), active_tab=0)


def _series(names: Sequence[str]) -> rr.SeriesLines:
    if len(names) <= len(SERIES):
        return rr.SeriesLines(names=list(names), colors=list(SERIES[: len(names)]))
    labels = [f"{100 * q:g} % of the loops" for q in QUANTILES[:-1]] + ["largest"]
    widths = [1.0, 1.5, 3.0, 1.5, 1.0, 1.0]
    colours = [CONTROLLER] * (len(QUANTILES) - 1) + [LOST]
    return rr.SeriesLines(names=labels, colors=colours, widths=widths)


def _curves_or_quantiles(values: Reals) -> Reals:
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
    highest = min(levels[known].max(initial=-np.inf), np.log10(_RANGE * usual_largest(errors)))
    share = np.clip(1 + (levels - highest) / _DECADES, 0, 1) if known.any() else levels
    pixels = colormaps["viridis"](share, bytes=True)[..., :3]
    pixels[~known] = 0
    height = max(_ROW_PIXELS // len(errors), 1)
    width = max(2 * _ROW_PIXELS // errors.shape[1], 1)
    return np.asarray(pixels.repeat(height, axis=0).repeat(width, axis=1), np.uint8)


def open_recording(run: ResolvedRun, run_dir: Path, run_id: int, live: LiveView | None) -> RunRecording:
    """Create the recording of a run, which is written while the run goes on."""
    shown = dict(enumerate(run.loops)) if len(run.names) <= MOST_PICTURED else {}
    scenario = run.scenario if len(run.names) > 1 else run.loops[0]
    return RunRecording(scenario, run_dir / RECORDING_FILE, run_id, shown, live=live)


def write_view(
    run: RecordedRun,
    summary: RunSummary,
    run_dir: Path,
    loop: str | None,
    over_time: Sequence[LoopOverTime] | None = None,
) -> None:
    """Write the recording of a run, or of one of its loops, from its record and its summary.

    ``over_time`` is how each loop of the run went, if that is known.

    Raises:
        ViewError: the recording cannot be written.
    """
    if loop is None and len(run.names) > 1:
        _write_network_view(run, summary, run_dir, loops_over_time(run, over_time))
    else:
        write_loop_view(run.loop(loop), run_dir / file_of_loop(RECORDING_FILE, loop))


def write_loop_view(record: RunRecord, path: Path) -> None:
    """Write the recording of one loop; that of a long run shows extremes only."""
    require_space(path.parent)
    scenario, kind = record.scenario, record.kind
    with RunRecording(scenario, path, _new_id(), {0: scenario}, kind, complete=True) as recording:
        _feed_record(record, recording)


def _new_id() -> int:
    """Return an identity, by which the viewer distinguishes recordings."""
    return secrets.randbits(64)


def _write_network_view(
    run: RecordedRun, summary: RunSummary, run_dir: Path, over_time: LoopsOverTime
) -> None:
    require_space(run_dir)
    worst, count, path = worst_loop(summary.loops), len(run.names), run_dir / RECORDING_FILE
    numbers = range(count) if count <= MOST_PICTURED else [worst.number]
    loops = {number: run.record(number).scenario for number in numbers}
    with RunRecording(
        run.scenario, path, _new_id(), loops, run.kind, worst=worst, complete=True
    ) as recording:
        in_flight = summary.network.in_flight
        largest = np.array(in_flight.max_by_interval, np.float64)
        queue_ns = (np.arange(len(largest)) + 0.5) * in_flight.width_s * NS_PER_S
        recording.add_queue(queue_ns.astype(np.int64), largest, np.array(in_flight.mean_by_interval))
        middles_ns = (over_time.middles_s * NS_PER_S).astype(np.int64)
        recording.add_norms(ALL_ERRORS, middles_ns, over_time.errors)
        recording.add_norms(ALL_SIZES, middles_ns, over_time.states)
        recording.add_map(over_time.errors)
        ends_s, shares = over_time.shares()
        recording.add_shares(((ends_s - ends_s[0] / 2) * NS_PER_S).astype(np.int64), shares)
        for notice in run.network.notices:
            recording.log(int(notice["t_ns"]), log_level(notice), str(notice["text"]))
        for number in numbers:
            _feed_record(run.record(number), recording, number)


def _feed_record(record: RunRecord, recording: RunRecording, number: int = 0) -> None:
    """Pass a loop's record to its view, part by part, while there is space in the folder."""
    columns = record.slice_columns if is_long(record.scenario) else None
    feed = LoopFeed(record.scenario, recording.views[number], columns)
    for i, part in enumerate(record.slices()):
        require_space(recording.path.parent)
        if i:
            feed.advance()
            recording.flush()
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
