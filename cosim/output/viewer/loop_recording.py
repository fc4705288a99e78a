"""The recording of a run for the viewer, as a rerun file that is written while the run goes on.

:class:`RecordingFile` writes the file, :class:`LoopView` the signals, events, packets and log of a
loop. The recording is only for viewing: the run's data are in the Parquet files, and only similar
versions of rerun can read a recording.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from cosim.output.viewer import blueprint as bp
from cosim.output.viewer.network_diagram import DIAGRAM, LEG_S
from cosim.output.viewer.pictures.picture import PICTURE, TIMELINE, Frames, concatenate_frames
from cosim.record.align import AlignedRun, Reals, Times
from cosim.record.run_directory import Kind
from netem.core.clock import NS_PER_S
from netem.core.errors import MachineError, why
from netem.core.file_access import open_growing
from noack.scenario.scenario import Scenario

APPLICATION_ID = "noack"
_LOG_DEPTH, _LOG_FLOOR = 1e-3, 1e-12
"""Errors, which are reset to 0, are cut off at this share of the threshold, or at the second number if
that is larger: the logarithm of 0 cannot be drawn."""
_FRAMES_AT_ONCE = 12
"""Frames per batch; a batch needs more than a kilobyte for each moving entity."""


class ViewError(MachineError):
    """The recording could not be written; the message names the file and the cause."""


class RecordingFile:
    """Writes a ``.rrd`` file. Data are passed to the operating system as they arrive.

    Hence the file can be shown while it grows, and read after a crash.

    Args:
        path: the file; replaced if it exists.
        run_id: identity of the recording, unique among runs.
        layout: layout of the viewer's panels.
        indexed: end the file with an index of its chunks. Until then the index is kept in memory,
            about 200 bytes per chunk. A recording of several hours has no index; readers must then
                read all of it.

    Raises:
        ViewError: the file cannot be created.
    """

    def __init__(self, path: Path, run_id: str, layout: rrb.Blueprint, *, indexed: bool) -> None:
        self.path = path
        self._open = True
        self._stream = rr.RecordingStream(APPLICATION_ID, recording_id=run_id)
        try:
            descriptor = open_growing(path)
            try:  # by its descriptor, as rerun would follow a link
                own = f"/dev/fd/{descriptor}" if hasattr(os, "O_NOFOLLOW") else str(path)
                self._stream.save(own, default_blueprint=layout, write_footer=indexed)
            finally:
                os.close(descriptor)
        except (OSError, RuntimeError) as error:
            reason = why(error) if isinstance(error, OSError) else str(error)
            raise ViewError(f"{path}: cannot create the recording: {reason}") from None

    def describe(self, title: str, static: Mapping[str, rr.AsComponents]) -> None:
        """Set the recording's title and its static data, by entity."""
        self._stream.send_recording_name(title)
        self.add_static(static)

    def add_static(self, static: Mapping[str, rr.AsComponents]) -> None:
        """Add static data, by entity."""
        for entity, shape in static.items():
            self._stream.log(entity, shape, static=True)

    def send(self, entity: str, t_ns: Times, values: Reals) -> None:
        """Add scalars (k,) or (k, series) at times (k,); a value that is not finite is a gap."""
        if len(values):
            finite = np.where(np.isfinite(values), values, np.nan)
            self.send_columns(entity, t_ns, rr.Scalars.columns(scalars=finite))

    def send_columns(self, entity: str, t_ns: Times, columns: Iterable[rr.ComponentColumn]) -> None:
        """Add columns of any components at times (k,).

        Raises:
            ViewError: the columns cannot be written.
        """
        times = rr.TimeColumn(TIMELINE, duration=np.asarray(t_ns).astype("timedelta64[ns]"))
        try:
            self._stream.send_columns(entity, [times], columns, strict=True)
        except RuntimeError as error:
            raise ViewError(f"{self.path}: cannot write the recording: {error}") from None

    def log(self, t_ns: int, level: str, text: str, folder: str = "") -> None:
        """Add one line to the log; ``level`` is one of rerun's, such as INFO or WARN."""
        line = f"{t_ns / 1e9:8.3f} s  {text}"
        columns = rr.TextLog.columns(text=[line], level=[level])
        self.send_columns(f"{folder}{bp.LOG}", np.array([t_ns], dtype=np.int64), columns)

    def flush(self) -> None:
        """Pass buffered data to the operating system."""
        try:
            self._stream.flush()
        except RuntimeError as error:
            raise ViewError(f"{self.path}: cannot write the recording: {error}") from None

    def close(self) -> None:
        """Write the file's footer; a second call does nothing.

        Raises:
            ViewError: the file could not be written in full.
        """
        if not self._open:
            return
        self._open = False
        try:
            self._stream.flush()
        except RuntimeError as error:
            raise ViewError(f"{self.path}: the recording is incomplete: {error}") from None
        finally:
            self._stream.disconnect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def run_text(scenario: Scenario, kind: Kind = "live") -> str:
    """Return the viewer's text about a run, in Markdown."""
    network = scenario.network
    lateness = {
        "live": "* **Lateness**: wall time between a deadline and the process's action.",
        "simulated": "* The run was **simulated** in virtual time: no deadline was missed.",
    }[kind]
    hold = "a model of the plant" if scenario.mode == "model" else "a zero-order hold"
    return f"""# {scenario.name}

{scenario.description}

Sensor and controller run **{hold}** between updates. The sensor transmits when
{scenario.trigger.description}.
The network ({network.loss.model.replace("_", "-")} loss) guarantees:
{network.guarantee.meaning}.
{scenario.protocol.summary}

* A window opens a finished run at its largest ‖e_c‖. **Colours** explains the colours.
* **Picture**: the plant (solid), the sensor's model (outline) and the controller's model (dashed
  outline). Play the run to animate it.
* **Packets**: each update in flight. A lost one falls; a forced delivery is a diamond. A flight
  takes microseconds but is animated as {LEG_S:g} s per hop, so x_c jumps before the dot arrives.
* **States**: the plant's x, the sensor's model x_s (reset {scenario.protocol.reset}), the
  controller's model x_c (reset by each delivery). Where x_c differs from the other two, packets
  were lost.
* **Intervals**: time since the previous transmission, and since the previous delivery.
* **Errors**: e_s = x_s − x with its threshold; e_c = x_c − x with two bounds, one from identity
  (I1) and the certified one. No process of the loop can measure e_c. The certified bound holds
  while no process is later than the certificate allows (see the claims of the summary).
{lateness}
"""


class LoopView:
    """Writes what is shown of one loop. Every method takes a batch of one kind, ordered in time.

    Times are int64 nanoseconds of simulated time since the loop's start.

    Args:
        file: the recording.
        layout: what is shown; its static data are written here.
    """

    def __init__(self, file: RecordingFile, layout: bp.LoopLayout) -> None:
        self._file, self._layout = file, layout
        self._states = [bp.state_path(name) for name in layout.state_names]
        self._frame = -1
        self._waiting: list[tuple[Times, Frames]] = []
        file.add_static(layout.static())

    def _send(self, entity: str, t_ns: Times, values: Reals) -> None:
        at_ns = np.asarray(t_ns) + self._layout.phase_ns
        self._file.send(f"{self._layout.folder}{entity}", at_ns, values)

    def _send_columns(self, entity: str, t_ns: Times, columns: Iterable[rr.ComponentColumn]) -> None:
        at_ns = np.asarray(t_ns) + self._layout.phase_ns
        self._file.send_columns(f"{self._layout.folder}{entity}", at_ns, columns)

    def _send_stems(self, entity: str, t_ns: Times, height: Reals) -> None:
        """Add lines from 0 to each height (k,) at times (k,), with a gap after each."""
        line = np.stack((np.zeros_like(height), height, np.full_like(height, np.nan)), axis=1)
        self._send(entity, np.repeat(t_ns, 3), line.ravel())

    def log(self, t_ns: int, level: str, text: str) -> None:
        """Add one line to the loop's log; ``level`` is one of rerun's, such as INFO or WARN."""
        self._file.log(t_ns + self._layout.phase_ns, level, text, self._layout.folder)

    def add_samples(
        self, aligned: AlignedRun, e_c_bounds: Reals, x_bounds: Reals, y_bounds: Reals | None = None
    ) -> None:
        """Add k samples.

        Args:
            aligned: states, errors and threshold on a common time grid.
            e_c_bounds: (k, 2) bounds of ‖e_c‖, from (I1) and certified; NaN for none.
            x_bounds: (k,) certified bounds of ‖x‖; NaN for none.
            y_bounds: (k, p) certified bounds of the layout's outputs; NaN for none. None: of all.
        """
        t_ns = aligned.t_ns
        states, reference = [aligned.x, aligned.x_s, aligned.x_c], self._layout.reference
        if reference is not None:
            states.append(reference.states(t_ns))
        of_each = np.stack(states, axis=2)
        for i, entity in enumerate(self._states):
            self._send(entity, t_ns, of_each[:, i, :])
        measured = (aligned.e_s_norm, aligned.threshold, aligned.e_c_norm)
        norms = np.column_stack([e_c_bounds[:, 0], *measured, e_c_bounds[:, 1]])
        # On a linear scale, a certified bound would flatten everything else.
        self._send(bp.ERROR, t_ns, norms[:, :4])
        self._send(bp.ERROR_LOG10, t_ns, _log10(norms, aligned.threshold))
        deviations = aligned.x if reference is None else aligned.x - reference.states(t_ns)
        sizes = np.column_stack([x_bounds, np.linalg.norm(deviations, axis=1)])
        self._send(bp.SIZE_LOG10, t_ns, _log10(sizes, aligned.threshold))
        for i, output in enumerate(self._layout.outputs):
            bound = np.full(len(t_ns), np.nan) if y_bounds is None else y_bounds[:, i]
            allowed = np.full(len(t_ns), np.nan if output.allowed is None else output.allowed)
            distance = np.abs(deviations @ np.array(output.row))
            of_output = np.column_stack([bound, allowed, distance])
            self._send(bp.output_path(output.name), t_ns, _log10(of_output, allowed))

    def add_frames(self, t_ns: Times, frames: Frames) -> None:
        """Add states at times (k,) to the plant's picture, at its frame rate."""
        if self._layout.picture is None:
            return
        frame = t_ns // round(NS_PER_S / self._layout.picture.rate_hz)
        new = np.diff(frame, prepend=self._frame) > 0
        if not new.any():
            return
        self._frame = int(frame[-1])
        self._waiting.append((t_ns[new], frames.at(new)))
        if sum(len(times) for times, _ in self._waiting) >= _FRAMES_AT_ONCE:
            self.write_frames()

    def write_frames(self) -> None:
        """Write the waiting frames of the picture."""
        if self._layout.picture is None or not self._waiting:
            return
        t_ns = np.concatenate([times for times, _ in self._waiting])
        frames = concatenate_frames([frames for _, frames in self._waiting])
        self._waiting = []
        for entity, columns in self._layout.picture.frames(frames).items():
            self._send_columns(f"{PICTURE}/{entity}", t_ns, columns)

    def add_packets(
        self,
        t_ns: Times,
        release_ns: Times,
        fate: npt.NDArray[np.int64],
        *,
        reverse: bool = False,
    ) -> None:
        """Add packets (p,) to the network's diagram; see :meth:`NetworkDiagram.add`."""
        if self._layout.diagram is not None:
            self._layout.diagram.add(t_ns, release_ns, fate, reverse=reverse)

    def animate_packets(self, until_ns: int) -> None:
        """Animate the packets up to a time by which all of them were added."""
        if self._layout.diagram is None:
            return
        for entity, moving in self._layout.diagram.advance(until_ns).items():
            self._send_columns(f"{DIAGRAM}/{entity}", moving.t_ns, moving.columns)

    def add_certified_interval(self, interval_s: float, until_ns: int) -> None:
        """Draw the certified minimum inter-event time, from 0 to ``until_ns``."""
        self._send(bp.EVENT_CERTIFIED, np.array([0, until_ns]), np.full(2, interval_s))

    def add_inputs(self, t_ns: Times, u: Reals) -> None:
        """Add the control input u (k, m) at times (k,)."""
        self._send(bp.INPUT, t_ns, u)

    def add_transmissions(self, t_ns: Times, interval_s: Reals) -> None:
        """Add events: times t_i (k,) and t_i − t_{i−1} in seconds (k,), NaN (drawn 0) for none."""
        interval_s = np.nan_to_num(interval_s)
        self._send_stems(bp.EVENT_STEM, t_ns, interval_s)
        self._send(bp.EVENT, t_ns, interval_s)

    def add_deliveries(self, t_ns: Times, interval_s: Reals, forced: npt.NDArray[np.bool_]) -> None:
        """Add deliveries: times (k,), seconds since the previous one (k,), forced (k,).

        A delivery is forced if ``mansd`` updates in a row were lost before it. An interval that is
        NaN is drawn as 0.
        """
        interval_s = np.nan_to_num(interval_s)
        forced = np.asarray(forced, dtype=bool)
        self._send_stems(bp.RECEPTION_STEM, t_ns, interval_s)
        self._send(bp.RECEPTION, t_ns[~forced], interval_s[~forced])
        self._send(bp.RECEPTION_FORCED, t_ns[forced], interval_s[forced])

    def add_losses(self, t_ns: Times) -> None:
        """Add the times (k,) at which an update was lost."""
        self._send(bp.DROP, t_ns, np.zeros(len(t_ns)))

    def add_lateness(self, process: str, t_ns: Times, lateness_us: Reals) -> None:
        """Add a process's lateness in µs (k,) at times (k,), if it is shown."""
        if process in self._layout.processes:
            self._send(bp.lateness_path(process), t_ns, lateness_us)


def _log10(norms: Reals, threshold: Reals) -> Reals:
    """Return the decimal logarithm of norms (k, series), cut off below the threshold (k,)."""
    level = np.nan_to_num(threshold, nan=0.0, posinf=0.0)[:, None]
    floor = np.maximum(_LOG_DEPTH * level, _LOG_FLOOR)
    return np.log10(np.maximum(norms, floor))
