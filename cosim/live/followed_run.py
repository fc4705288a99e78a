"""An active run for a program beside it: the rows that its processes send to the recorder.

They come from the router of the run's control plane. The run does not wait for who receives them,
and does not know of it.
"""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zenoh
from numpy.typing import NDArray
from zenoh.handlers import RingChannel

from cosim.record.run_directory import SCENARIO_FILE
from netem.core.errors import CallerError, PeerError, did_you_mean
from noack.protocol.record_tables import LOOP
from noack.runtime.active_runs import RUNS, OpenRun, active_runs, find_run
from noack.runtime.connections.zenoh_session import cause_of, header_of, open_session
from noack.runtime.control_messages import LogLine, parse_message
from noack.runtime.spool import NOTICES, lines_in
from noack.scenario import scenario_file
from noack.scenario.resolution import ResolvedRun, loop_of

_NOTICE = np.dtype([("t_ns", np.int64), ("level", object), ("text", object), ("process", object)])
_WAITING_BATCHES = 4096
_POLL_S, _LOOK_S = 0.005, 0.5
"""Waits for rows, and for the end of the run."""


class FollowedLoop(NamedTuple):
    """A loop of an active run."""

    name: str
    states: tuple[str, ...]
    """Names of the states."""
    inputs: tuple[str, ...]
    """Names of the inputs."""
    phase_ns: int
    """Time of the run at which the loop's own time begins."""


_WHOLE_RUN = FollowedLoop("", (), (), 0)


class LiveRows(NamedTuple):
    """Rows that a process of an active run has sent."""

    table: str
    """Name of the table; ``docs/record.md`` has them."""
    loop: FollowedLoop
    """Its name is empty for notices about the whole run, whose times are those of the run."""
    rows: NDArray[np.void]
    """A structured array; times are those of the loop. That of ``notices`` has the fields ``t_ns``,
    ``level``, ``text`` and ``process``."""


class FollowedRun:
    """An active run; ``noack.follow`` returns it."""

    def __init__(self, run: OpenRun) -> None:
        self._run = run
        self.directory = Path(run.run_dir)
        """The run directory, which is being written."""
        resolved = ResolvedRun(scenario_file.load(self.directory / SCENARIO_FILE))
        self._types = resolved.tables
        matrices = [(loop.name, loop_of(loop)) for loop in resolved.loops]
        self.loops = tuple(
            FollowedLoop(name, loop.state_names, loop.input_names, phase_ns)
            for (name, loop), phase_ns in zip(matrices, resolved.phases_ns, strict=True)
        )
        """Its loops."""

    def rows(self, *tables: str) -> Iterator[LiveRows]:
        """Return an iterator of the rows of some tables, from now to the end of the run.

        Each process sends a batch every 50 ms at most. Of each process and table the rows are in
        order. Who is slower than the run misses the oldest ones; the recorder has them all.

        Args:
            tables: names of tables of the record, or ``notices``: the lines of the processes for the
                run's log. The recorder's own lines are in the record only.

        Raises:
            CallerError: there is no such table.
            NoackError: the run cannot be reached.
        """
        known = [*self._types, NOTICES]
        for table in tables:
            if table not in known:
                hint = did_you_mean(table, known) or f"the tables are {', '.join(known)}"
                raise CallerError(f"{table}: a run has no such table; {hint}")
        if not tables:
            raise CallerError(f"name the tables to follow; a run has {', '.join(known)}")
        return self._batches(tables)

    def _batches(self, tables: tuple[str, ...]) -> Iterator[LiveRows]:
        with ExitStack() as stack:
            try:
                session = stack.enter_context(open_session(RUNS, self._run.name, listen=False))
            except zenoh.ZError as error:
                reason = cause_of(error)
                raise PeerError(f"{self.directory}: the run cannot be reached: {reason}") from None
            key = f"noack/{self._run.name}/telemetry/*/*"
            batches = session.declare_subscriber(key, RingChannel(_WAITING_BATCHES))
            looked_s, is_active = time.monotonic(), True
            while True:
                if (sample := batches.try_recv()) is not None:
                    yield from self._rows_of(sample, tables)
                    continue
                if not is_active:
                    return
                if time.monotonic() - looked_s > _LOOK_S:
                    looked_s = time.monotonic()
                    is_active = any(active.name == self._run.name for active in active_runs())
                time.sleep(_POLL_S)

    def _rows_of(self, sample: zenoh.Sample, tables: tuple[str, ...]) -> Iterator[LiveRows]:
        role, table = str(sample.key_expr).split("/")[-2:]
        if table not in tables or header_of(sample) is None:
            return
        if table == NOTICES:
            yield from self._notices(role, sample.payload.to_bytes())
            return
        rows = np.frombuffer(sample.payload.to_bytes(), self._types[table])
        for loop in np.unique(rows[LOOP]).tolist():
            yield LiveRows(table, self.loops[loop], rows[rows[LOOP] == loop])

    def _notices(self, process: str, batch: bytes) -> Iterator[LiveRows]:
        """Yield each line of a batch for the log."""
        for text in lines_in(batch):
            line = parse_message(LogLine, text)
            number = 0 if line.loop is None and len(self.loops) == 1 else line.loop
            row = np.array([(line.t_ns, line.level, line.text, process)], _NOTICE)
            yield LiveRows(NOTICES, _WHOLE_RUN if number is None else self.loops[number], row)


def follow(directory: str | Path, *, timeout_s: float = 30.0) -> FollowedRun:
    """Return the active run of a run directory, to follow it from another thread or program.

    Args:
        directory: the run directory.
        timeout_s: longest wait for a run that is about to start.

    Raises:
        NoackError: it is not active in time, or its scenario cannot be read.
    """
    until_s = time.monotonic() + timeout_s
    while True:
        try:
            return FollowedRun(find_run(run_dir=Path(directory)))
        except CallerError:
            if time.monotonic() > until_s:
                raise
            time.sleep(_POLL_S)
