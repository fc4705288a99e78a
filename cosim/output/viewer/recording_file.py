"""A rerun recording as a file that is written while a run goes on."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import rerun as rr
import rerun.blueprint as rrb

from cosim.output.viewer.pictures.picture import TIMELINE
from noack.core.errors import MachineError, why
from noack.core.file_access import open_growing

Floats = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

APPLICATION_ID = "noack"
LOG = "log"
"""Entity of the run's log."""


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
                own = f"/dev/fd/{descriptor}"
                self._stream.save(own, default_blueprint=layout, write_footer=indexed)
            finally:
                os.close(descriptor)
        except (OSError, RuntimeError) as error:
            reason = why(error) if isinstance(error, OSError) else str(error)
            raise ViewError(f"{path}: cannot create the recording: {reason}") from None

    def describe(self, title: str, static: dict[str, Any]) -> None:
        """Set the recording's title and its static data, by entity."""
        self._stream.send_recording_name(title)
        self.add_static(static)

    def add_static(self, static: dict[str, Any]) -> None:
        """Add static data, by entity."""
        for entity, shape in static.items():
            self._stream.log(entity, shape, static=True)

    def send(self, entity: str, t_ns: Nanoseconds, values: Floats) -> None:
        """Add scalars (k,) or (k, series) at times (k,); a value that is not finite is a gap."""
        if len(values):
            finite = np.where(np.isfinite(values), values, np.nan)
            self.send_columns(entity, t_ns, rr.Scalars.columns(scalars=finite))

    def send_columns(
        self, entity: str, t_ns: Nanoseconds, columns: Iterable[rr.ComponentColumn]
    ) -> None:
        """Add columns of any components at times (k,).

        Raises:
            ViewError: the columns cannot be written.
        """
        times = rr.TimeColumn(TIMELINE, duration=np.asarray(t_ns).astype("timedelta64[ns]"))
        try:
            self._stream.send_columns(entity, [times], columns, strict=True)
        except RuntimeError as error:
            raise ViewError(f"{self.path}: cannot write the recording: {error}") from None

    def send_stems(self, entity: str, t_ns: Nanoseconds, height: Floats) -> None:
        """Add lines from 0 to each height (k,) at times (k,), with a gap after each."""
        line = np.stack((np.zeros_like(height), height, np.full_like(height, np.nan)), axis=1)
        self.send(entity, np.repeat(t_ns, 3), line.ravel())

    def log(self, t_ns: int, level: str, text: str) -> None:
        """Add one line to the log; ``level`` is one of rerun's, such as INFO or WARN."""
        line = f"{t_ns / 1e9:8.3f} s  {text}"
        columns = rr.TextLog.columns(text=[line], level=[level])
        self.send_columns(LOG, np.array([t_ns], dtype=np.int64), columns)

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
