"""The view of a run: a rerun recording with its own layout, written while the run goes on.

The view is for people. The run's numbers of record are in its Parquet files; a recording is only
promised to be readable by neighbouring versions of rerun.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt
import rerun as rr

from cosim.output.viewer import blueprint as bp
from cosim.output.viewer.colour_key import COLOUR_KEY, ColourKey
from cosim.output.viewer.live_viewer import LiveView
from cosim.output.viewer.pictures.network_picture import DIAGRAM, NetworkDiagram
from cosim.output.viewer.pictures.picture import PICTURE, TIMELINE, Frames, Picture, joined
from noack.core.clock import NS_PER_S
from noack.core.errors import MachineError

Floats = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

APPLICATION_ID = "noack"

# A reset error is zero, whose logarithm is not a point of the plot: errors are drawn down to this
# fraction of the threshold, and no lower than the smallest error worth a look.
_LOG_DEPTH = 1e-3
_LOG_FLOOR = 1e-12
_FRAMES_AT_ONCE = 12
"""A batch of them takes more than a kilobyte by itself, once for everything that moves."""


class ViewError(MachineError):
    """The recording could not be written; the message names the file and the cause."""


class RunView:
    """Writes ``recording.rrd``; every method takes batches of one kind, ordered in time.

    Times are int64 nanoseconds of simulated time since the run's epoch. Data is handed to the
    operating system as it comes, so the file can be shown while it grows and after a crash.

    Args:
        path: the file to write; replaced if it exists.
        run_id: identity of the recording, unique among runs.
        title: name shown for the recording.
        about: Markdown shown beside the plots.
        state_names: names of the n coordinates of x.
        input_names: names of the m coordinates of u.
        processes: names of the processes whose lateness is shown; none in a simulated run.
        horizon_s: the run's length, which the plots' time axis shows.
        picture: of the plant; None does without.
        diagram: of the network; None does without.
        live: shows the file while it is written.
        indexed: end the file with an index of its chunks, so that tools find what they look for.
            Until then the index is kept in memory, some 200 bytes for each chunk: a view that is
            written bit by bit for hours goes without, and is read in full.

    Raises:
        ViewError: the file cannot be created.
    """

    def __init__(
        self,
        path: Path,
        *,
        run_id: str,
        title: str,
        about: str,
        state_names: Sequence[str],
        input_names: Sequence[str],
        processes: Sequence[str],
        horizon_s: float,
        picture: Picture | None = None,
        diagram: NetworkDiagram | None = None,
        live: LiveView | None = None,
        indexed: bool = True,
    ) -> None:
        self._path = path
        self._states = [bp.state_path(name) for name in state_names]
        self._lateness = {name: bp.lateness_path(name) for name in processes}
        self._n, self._m = len(state_names), len(input_names)
        self._picture, self._diagram = picture, diagram
        self._frame = -1
        self._waiting: list[tuple[Nanoseconds, Frames]] = []
        self._open = True
        self._live = live
        self._recording = rr.RecordingStream(APPLICATION_ID, recording_id=run_id)
        names = (state_names, input_names, processes)
        try:
            layout = bp.layout(*names, horizon_s, picture=picture, diagram=diagram)
            self._recording.save(path, default_blueprint=layout, write_footer=indexed)
        except RuntimeError as error:
            raise ViewError(f"{path}: cannot create the recording: {error}") from None
        self._recording.send_recording_name(title)
        document = rr.TextDocument(about, media_type=rr.MediaType.MARKDOWN)
        self._recording.log(bp.ABOUT, document, static=True)
        for entity, style in bp.styles(*names).items():
            self._recording.log(entity, style, static=True)
        key = ColourKey(input_names)
        for below, drawing in ((PICTURE, picture), (DIAGRAM, diagram), (COLOUR_KEY, key)):
            for entity, shape in ({} if drawing is None else drawing.scenery()).items():
                self._recording.log(f"{below}/{entity}", shape, static=True)
        if live is not None:
            live.show(path)

    def samples(
        self,
        t_ns: Nanoseconds,
        x: Floats,
        x_s: Floats,
        x_c: Floats,
        e_s_norm: Floats,
        threshold: Floats,
        e_c_norm: Floats,
        e_c_bounds: Floats,
        x_bound: Floats,
    ) -> None:
        """Add k samples.

        Args:
            t_ns: times (k,).
            x: plant states (k, n).
            x_s: the sensor's model (k, n).
            x_c: the controller's model (k, n).
            e_s_norm: ‖e_s‖ (k,).
            threshold: of the trigger (k,).
            e_c_norm: ‖e_c‖ (k,).
            e_c_bounds: of e_c_norm, from (I1) and certified (k, 2); NaN for none.
            x_bound: certified bound of ‖x‖ (k,); NaN for none.
        """
        times = self._times(t_ns)
        k = len(t_ns)
        x, x_s, x_c = (
            _shaped(name, value, (k, self._n))
            for name, value in (("x", x), ("x_s", x_s), ("x_c", x_c))
        )
        triples = np.stack((x, x_s, x_c), axis=2)
        for i, entity in enumerate(self._states):
            self._send(entity, times, triples[:, i, :])
        measured = [
            _shaped(name, value, (k,))
            for name, value in (
                ("e_s_norm", e_s_norm),
                ("threshold", threshold),
                ("e_c_norm", e_c_norm),
            )
        ]
        bounds = _shaped("e_c_bounds", e_c_bounds, (k, 2))
        norms = np.column_stack([bounds[:, 0], *measured, bounds[:, 1]])
        # On a linear scale, a certified bound would flatten everything else.
        self._send(bp.ERROR, times, norms[:, :4])
        self._send(bp.ERROR_LOG10, times, _log10(norms, threshold))
        sizes = np.column_stack([np.linalg.norm(x, axis=1), _shaped("x_bound", x_bound, (k,))])
        self._send(bp.SIZE_LOG10, times, _log10(sizes, threshold))

    def move(self, t_ns: Nanoseconds, frames: Frames) -> None:
        """Add states at times (k,) to the plant's picture, which shows as many as it needs."""
        if self._picture is None:
            return
        frame = t_ns // round(NS_PER_S / self._picture.rate_hz)
        new = np.diff(frame, prepend=self._frame) > 0
        if not new.any():
            return
        self._frame = int(frame[-1])
        self._waiting.append((t_ns[new], frames.at(new)))
        if sum(len(times) for times, _ in self._waiting) >= _FRAMES_AT_ONCE:
            self._draw()

    def _draw(self) -> None:
        """Write the frames that wait."""
        if self._picture is None or not self._waiting:
            return
        t_ns = np.concatenate([times for times, _ in self._waiting])
        frames = joined([frames for _, frames in self._waiting])
        self._waiting = []
        for entity, columns in self._picture.frames(frames).items():
            self._send_columns(f"{PICTURE}/{entity}", self._times(t_ns), columns)

    def packets(
        self,
        t_ns: Nanoseconds,
        release_ns: Nanoseconds,
        fate: npt.NDArray[np.int64],
        *,
        back: bool = False,
    ) -> None:
        """Add packets (p,) to the network's diagram; see :meth:`NetworkDiagram.add`."""
        if self._diagram is not None:
            self._diagram.add(t_ns, release_ns, fate, back=back)

    def travel(self, until_ns: int) -> None:
        """Let the packets travel up to a time by which all of them were added."""
        if self._diagram is None:
            return
        for entity, moving in self._diagram.advance(until_ns).items():
            self._send_columns(f"{DIAGRAM}/{entity}", self._times(moving.t_ns), moving.columns)

    def certified_interval(self, interval_s: float, until_ns: int) -> None:
        """Draw the certified least time between two broadcasts, from 0 to ``until_ns``."""
        ends_ns = np.array([0, until_ns], dtype=np.int64)
        self._send(bp.EVENT_CERTIFIED, self._times(ends_ns), np.full(2, interval_s))

    def inputs(self, t_ns: Nanoseconds, u: Floats) -> None:
        """Add the control input u (k, m) at times (k,)."""
        self._send(bp.INPUT, self._times(t_ns), _shaped("u", u, (len(t_ns), self._m)))

    def broadcasts(self, t_ns: Nanoseconds, interval_s: Floats) -> None:
        """Add events: times t_i (k,) and t_i − t_{i−1} in seconds (k,).

        The first event has no predecessor, hence interval NaN; it is drawn as a mark at 0.
        """
        interval_s = np.nan_to_num(_shaped("interval_s", interval_s, (len(t_ns),)))
        self._send(bp.EVENT_STEM, *self._stems(t_ns, interval_s))
        self._send(bp.EVENT, self._times(t_ns), interval_s)

    def receptions(
        self, t_ns: Nanoseconds, interval_s: Floats, forced: npt.NDArray[np.bool_]
    ) -> None:
        """Add deliveries: times (k,), seconds since the one before (k,), forced (k,).

        A delivery is forced when the network had to let it through, because M−1 updates in a row
        had just been dropped. The first interval is NaN and drawn as a mark at 0.
        """
        interval_s = np.nan_to_num(_shaped("interval_s", interval_s, (len(t_ns),)))
        forced = np.asarray(forced, dtype=bool)
        self._send(bp.RECEPTION_STEM, *self._stems(t_ns, interval_s))
        self._send(bp.RECEPTION, self._times(t_ns[~forced]), interval_s[~forced])
        self._send(bp.FORCED, self._times(t_ns[forced]), interval_s[forced])

    def drops(self, t_ns: Nanoseconds) -> None:
        """Add the times (k,) at which an update was dropped."""
        self._send(bp.DROP, self._times(t_ns), np.zeros(len(t_ns)))

    def lateness(self, process: str, t_ns: Nanoseconds, lateness_us: Floats) -> None:
        """Add how late a process was, in microseconds (k,), at times (k,), if that is shown."""
        if process not in self._lateness:
            return
        values = _shaped("lateness_us", lateness_us, (len(t_ns),))
        self._send(self._lateness[process], self._times(t_ns), values)

    def log(self, t_ns: int, level: str, text: str) -> None:
        """Add one line to the log; ``level`` is one of rerun's, such as INFO or WARN."""
        line = f"{t_ns / 1e9:8.3f} s  {text}"
        columns = rr.TextLog.columns(text=[line], level=[level])
        times = self._times(np.array([t_ns], dtype=np.int64))
        self._send_columns(bp.LOG, times, columns)

    def flush(self) -> None:
        """Hand everything over to the operating system: what waits in between takes memory."""
        try:
            self._recording.flush()
        except RuntimeError as error:
            raise ViewError(f"{self._path}: cannot write the recording: {error}") from None

    def close(self) -> None:
        """Write what is left and the file's footer; a second call does nothing.

        Raises:
            ViewError: the file could not be written in full.
        """
        if not self._open:
            return
        self._open = False
        try:
            self._draw()
            self._recording.flush()
        except RuntimeError as error:
            raise ViewError(f"{self._path}: the recording is incomplete: {error}") from None
        finally:
            self._recording.disconnect()
            if self._live is not None:
                self._live.finish()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def _send(self, entity: str, times: rr.TimeColumn, values: Floats) -> None:
        """Send scalars (k,) or (k, series) to one entity; what is not finite leaves a gap."""
        if len(values):
            columns = rr.Scalars.columns(scalars=np.where(np.isfinite(values), values, np.nan))
            self._send_columns(entity, times, columns)

    def _send_columns(
        self, entity: str, times: rr.TimeColumn, columns: Iterable[rr.ComponentColumn]
    ) -> None:
        try:
            self._recording.send_columns(entity, [times], columns, strict=True)
        except RuntimeError as error:
            raise ViewError(f"{self._path}: cannot write the recording: {error}") from None

    @staticmethod
    def _times(t_ns: Nanoseconds) -> rr.TimeColumn:
        return rr.TimeColumn(TIMELINE, duration=np.asarray(t_ns).astype("timedelta64[ns]"))

    def _stems(self, t_ns: Nanoseconds, height: Floats) -> tuple[rr.TimeColumn, Floats]:
        """Draw lines that rise from 0 to each height (k,), with a gap after each."""
        zeros = np.zeros_like(height)
        line = np.stack((zeros, height, np.full_like(height, np.nan)), axis=1).ravel()
        return self._times(np.repeat(t_ns, 3)), line


def _shaped(name: str, value: Floats, shape: tuple[int, ...]) -> Floats:
    value = np.asarray(value, dtype=np.float64)
    if value.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, found {value.shape}")
    return value


def _log10(norms: Floats, threshold: Floats) -> Floats:
    """Decimal logarithm of norms (k, series), cut off below the threshold (k,)."""
    level = np.nan_to_num(threshold, nan=0.0, posinf=0.0)[:, None]
    floor = np.maximum(_LOG_DEPTH * level, _LOG_FLOOR)
    return np.log10(np.maximum(norms, floor))
