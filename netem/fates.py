"""The file of a fate trace: Parquet with a row for each received datagram, in order of arrival.

========================= =====================================================================
column
========================= =====================================================================
``link``, ``direction``   where it arrived; ``forward`` is from client to server
``flow``, ``packet``      number of its flow, and its number in the flow, from 0
``arrival_ns``            time of arrival, Unix time
``size_bytes``            size of the payload
``fate``                  :class:`noack.protocol.record_tables.Fate`
``consecutive_losses``    length of the loss burst that ends with it; 0 if it is delivered
``delay_ns``              from arrival to departure; −1: never forwarded
``copy_delay_ns``         the same for its duplicate; −1: no duplicate
``bit``, ``copy_bit``     flipped bit of it, and of its duplicate; −1: none
``hold_back_ns``          time for which the guarantee holds it back
========================= =====================================================================

The file's metadata has a JSON document under ``noack``: the version of the program, the links with
their seeds and their settings at the start, and the number of missing events.
"""

import json
import os
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError, model_validator

from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import DIRECTIONS, EVENT, Bytes, Direction, report_line
from noack.core.core_library import StructRows, dtype_of
from noack.core.errors import CallerError, one_line
from noack.core.file_access import open_growing, open_regular
from noack.guarantee.loss_guarantee import LossHistory
from noack.impairments.constraints import require_consistent
from noack.impairments.link_settings import Constraints, Decisions, Mansd
from noack.protocol.record_tables import Fate

FORMAT = 2
"""Version of the columns and metadata of a trace."""
METADATA = "noack"

NUMBERS: Mapping[str, str] = {
    "flow": "int64",
    "packet": "int64",
    "arrival_ns": "int64",
    "size_bytes": "int32",
    "fate": "int8",
    "consecutive_losses": "int32",
    "delay_ns": "int64",
    "copy_delay_ns": "int64",
    "bit": "int32",
    "copy_bit": "int32",
    "hold_back_ns": "int64",
}
"""Numeric columns and their types."""

_NAMES = pa.dictionary(pa.int16(), pa.string())
SCHEMA = pa.schema(
    [("link", _NAMES), ("direction", _NAMES)]
    + [(name, pa.from_numpy_dtype(np.dtype(kind))) for name, kind in NUMBERS.items()]
)


def description(specs: Sequence[LinkSpec], missing: int) -> dict[str, str]:
    """Return the metadata of a trace."""
    document: Mapping[str, object] = {
        "format": FORMAT,
        "version": version("noack"),
        "missing_events": missing,
        "links": [
            {
                "name": spec.name,
                "seed": spec.seed,
                **{name: getattr(spec, name).model_dump(mode="json") for name in DIRECTIONS},
            }
            for spec in specs
        ],
    }
    return {METADATA: json.dumps(document)}


_FIELDS = {"arrival_ns": "t_ns"}
"""Fields of an event whose columns have another name."""
_RAW = np.dtype((np.void, EVENT.itemsize))
"""Events as raw bytes; numpy copies these ten times as fast as records with fields."""
_GROUP_ROWS = 65_536
"""Rows of a row group of the file, which are written together."""
_MAGIC = b"PAR1"
_MAX_WAITING = 1_000_000
"""Rows that may wait to be written."""


class FateRecorder:
    """Writes a trace within the context.

    The relay never waits: an event that cannot be queued is counted as missing. A trace with
    missing events cannot be replayed; a line on standard error reports the first one immediately.

    Args:
        path: the file; it is replaced, and is complete when the context has ended.
        specs: the relay's links, in its order.
        max_waiting: maximum number of queued rows.

    Raises:
        CallerError: the file cannot be written, is not a Parquet file, or delays are not known.
    """

    wants_data = False

    def __init__(self, path: Path, specs: Sequence[LinkSpec], max_waiting: int = _MAX_WAITING) -> None:
        for spec in specs:
            if spec.forward.chooses or spec.reverse.chooses:
                raise CallerError(
                    f"--record-fates {path}: link {spec.name} has a rate that chooses what it sends: "
                    "no delay is known at the arrival; capture the packets instead"
                )
        self._path = path
        self._specs = specs
        self._names = (pa.array([spec.name for spec in specs]), pa.array(DIRECTIONS))
        self._columns = {
            name: np.empty(_GROUP_ROWS, kind)
            for name, kind in {"link": "int16", "direction": "int16", **NUMBERS}.items()
        }
        self._pending_rows = 0
        self._max_waiting = max_waiting
        self._queue: SimpleQueue[StructRows | str | None] = SimpleQueue()
        self._queued_rows = 0
        self._processed_rows = 0
        self._missing_rows = 0
        self._unwritten_rows = 0
        self._failed = False
        with suppress(OSError, ValueError), open_regular(path) as file:
            if file.read(len(_MAGIC)) not in (b"", _MAGIC):
                raise CallerError(
                    f"--record-fates {path}: exists and is not a Parquet file; choose another name"
                )
        try:
            descriptor = open_growing(path, follow=True)
            try:  # by its descriptor, as pyarrow would follow a link
                self._writer = pq.ParquetWriter(f"/dev/fd/{descriptor}", SCHEMA)
            finally:
                os.close(descriptor)
        except (OSError, ValueError) as error:
            raise CallerError(f"--record-fates {path}: cannot be written ({_reason(error)})") from None
        self._thread = threading.Thread(target=self._run, name="fates", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._queue.put(None)
        self._thread.join()

    @property
    def rows(self) -> int:
        """Number of rows in the file; valid after the context."""
        return self._processed_rows - self._unwritten_rows

    @property
    def missing_events(self) -> int:
        """Number of events that are not in the trace."""
        return self._missing_rows + self._unwritten_rows

    def take(self, events: StructRows, data: Bytes) -> None:
        """Queue the arrivals; called in the relay's thread."""
        try:
            rows = events.view(_RAW)[events["departure"] == 0]
        except MemoryError:
            self.add_missing(len(events))
            return
        if self._queued_rows - self._processed_rows + len(rows) > self._max_waiting:
            self.add_missing(len(rows))
        elif len(rows):
            self._queued_rows += len(rows)
            self._queue.put(rows)

    def add_missing(self, events: int) -> None:
        """Count events for which the relay had no room; called in its thread."""
        if self._missing_rows == 0 and events:
            self._queue.put("events are missing: they arrive faster than they can be written")
        self._missing_rows += events

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            if isinstance(item, str):
                self._report(item)
            else:
                self._append(item.view(EVENT))
        if self._pending_rows:
            self._write()
        self._end()

    def _append(self, rows: StructRows) -> None:
        """Copy rows into columns, in groups, to release the interpreter lock often."""
        while len(rows):
            part, rows = np.split(rows, [_GROUP_ROWS - self._pending_rows])
            places = slice(self._pending_rows, self._pending_rows + len(part))
            for name, column in self._columns.items():
                column[places] = part[_FIELDS.get(name, name)]
            self._pending_rows += len(part)
            if self._pending_rows == _GROUP_ROWS:
                self._write()

    def _write(self) -> None:
        rows, self._pending_rows = self._pending_rows, 0
        if not self._failed:
            columns: list[pa.Array[Any]] = [
                pa.DictionaryArray.from_arrays(self._columns[name][:rows], names)
                for name, names in zip(("link", "direction"), self._names, strict=True)
            ]
            columns += [pa.array(self._columns[name][:rows]) for name in NUMBERS]
            try:
                self._writer.write_table(pa.Table.from_arrays(columns, schema=SCHEMA))
            except OSError as error:
                self._fail(error)
        if self._failed:
            self._unwritten_rows += rows
        self._processed_rows += rows

    def _end(self) -> None:
        try:
            self._writer.add_key_value_metadata(description(self._specs, self.missing_events))
            self._writer.close()
        except OSError as error:
            self._fail(error)
            self._unwritten_rows = self._processed_rows

    def _fail(self, error: OSError) -> None:
        if not self._failed:
            self._failed = True
            self._report(f"cannot be written ({_reason(error)})")

    def _report(self, problem: str) -> None:
        report_line(f"fate trace {self._path}: {problem}; it cannot be replayed; the relay continues")


def _reason(error: OSError | ValueError) -> str:
    # Arrow's message ends with "[errno 28] No space left on device".
    return str(error).rpartition("] ")[2]


_LONGEST_NS = 2**62
"""Maximum delay: its sum with a time fits into 64 bits."""
_LOST = (Fate.DROPPED, Fate.OVERFLOWED, Fate.BLACKED_OUT)


class Fates(NamedTuple):
    """The content of a trace, for each direction of each link."""

    decisions: Mapping[tuple[str, Direction], Decisions]
    guarantees: Mapping[tuple[str, Direction], Mapping[str, object]]
    """The keys ``mansd`` and ``constraints`` of its settings; none if the recorded fates break the
    guarantee, because it changed during the recording."""


def read_fates(path: Path, links: Sequence[str] | None = None) -> Fates:
    """Read a trace, for :class:`netem.link_state.LinkState`.

    A replaying link repeats the decisions of each flow, packet by packet: the same fate, the same
    flipped bits, and the same delay from arrival. Its guarantee holds even if the datagrams arrive
    at other times. For flows and packets beyond the trace, the link's own settings apply.

    Args:
        path: the file.
        links: the links to be replayed; None: all links of the trace.

    Raises:
        CallerError: the file is not a trace, has missing events, or lacks a link.
    """
    table, settings = _read(path)
    links_recorded = list(settings)
    for link in links or ():
        if link not in links_recorded:
            names = ", ".join(links_recorded)
            raise CallerError(f"{path}: has no link {link!r}; its links: {names}")
    columns = {name: table[name].to_numpy() for name in SCHEMA.names}
    decisions: dict[tuple[str, Direction], Decisions] = {}
    guarantees: dict[tuple[str, Direction], Mapping[str, object]] = {}
    for link in links_recorded if links is None else links:
        for direction in DIRECTIONS:
            is_here = (columns["link"] == link) & (columns["direction"] == direction)
            rows = {name: column[is_here] for name, column in columns.items()}
            decisions[link, direction] = _flows(rows, len(table), f"{path}: {link} {direction}")
            recorded: _RecordedDirection = getattr(settings[link], direction)
            guarantees[link, direction] = dict(recorded) if _keeps_guarantee(recorded, rows) else {}
    return Fates(decisions, guarantees)


def _keeps_guarantee(settings: "_RecordedDirection", rows: Mapping[str, NDArray[np.int64]]) -> bool:
    """Whether the losses of each flow are allowed, not counting those out of order."""
    losses = rows["consecutive_losses"]
    if settings.mansd is not None and losses.max(initial=0) > settings.mansd:
        return False
    if not settings.constraints:
        return True
    rules = [constraint.rule for constraint in settings.constraints]
    histories: dict[int, LossHistory] = {}
    order = np.lexsort((rows["packet"], rows["flow"]))
    flows, lost = rows["flow"][order].tolist(), (losses > 0)[order].tolist()
    return not any(
        histories.setdefault(flow, LossHistory(rules)).add(is_lost)
        for flow, is_lost in zip(flows, lost, strict=True)
    )


@contextmanager
def open_trace(path: Path) -> Iterator[tuple[pq.ParquetFile, Mapping[str, "_Link"]]]:
    """Open a trace; yields it, and the settings of its links at the start, by name.

    Raises:
        CallerError: the file is not a trace, has missing events, or cannot be read.
    """
    try:
        with pq.ParquetFile(path) as file:
            document = _document(path, (file.metadata.metadata or {}).get(METADATA.encode()))
            if not file.schema_arrow.equals(SCHEMA):
                raise CallerError(f"{path}: not a fate trace: it has other columns")
            if document.missing_events:
                raise _missing(path, document.missing_events)
            yield file, {link.name: link for link in document.links}
    except pa.ArrowInvalid:
        raise CallerError(
            f"{path}: not a fate trace, or incomplete because the emulator was killed"
        ) from None
    except (OSError, pa.ArrowException, UnicodeDecodeError) as error:
        raise CallerError(f"{path}: cannot be read ({one_line(error)})") from None


def _read(path: Path) -> tuple[pa.Table, Mapping[str, "_Link"]]:
    with open_trace(path) as (file, links):
        table = file.read()
        table.validate(full=True)
    if any(column.null_count for column in table.columns):
        raise _missing(path, "some")
    return table, links


def _missing(path: Path, count: int | str) -> CallerError:
    return CallerError(f"{path}: {count} events are missing; an incomplete trace cannot be replayed")


class _RecordedDirection(BaseModel):
    mansd: Mansd | None
    constraints: Constraints = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_consistent(self.mansd, self.constraints)
        return self


class _Link(BaseModel):
    name: str
    forward: _RecordedDirection
    reverse: _RecordedDirection


class _FormatHeader(BaseModel):
    format: int
    version: str


class _Document(_FormatHeader):
    """The part of a trace's metadata that a replay needs."""

    missing_events: Annotated[int, Field(ge=0)]
    links: list[_Link]


def _document(path: Path, text: bytes | None) -> _Document:
    try:
        header = _FormatHeader.model_validate_json(text or b"", strict=True)
        if header.format != FORMAT:
            raise CallerError(f"{path}: has the format of noack {header.version}; record it again")
        return _Document.model_validate_json(text or b"", strict=True)
    except ValidationError:
        raise CallerError(f"{path}: not a fate trace of this program") from None


def _flows(rows: Mapping[str, NDArray[np.int64]], most_flows: int, place: str) -> Decisions:
    """Return the decisions of each flow, from the rows of a direction."""
    _check(rows, most_flows, place)
    order = np.lexsort((rows["packet"], rows["flow"]))
    flows, packets = rows["flow"][order], rows["packet"][order]
    ends = np.flatnonzero(np.diff(flows, append=-1)) + 1
    begins = np.concatenate(([0], ends[:-1])) if len(ends) else ends
    expected = np.arange(len(packets)) - np.repeat(begins, ends - begins)
    wrong = np.flatnonzero(packets != expected)
    if len(wrong):
        k = wrong[0]
        raise CallerError(
            f"{place}: flow {flows[k]}: expected packet {expected[k]}, found {packets[k]}; "
            "an incomplete trace cannot be replayed"
        )
    decisions = np.empty(len(order), dtype_of("noack_recorded"))
    for name in decisions.dtype.names or ():
        decisions[name] = rows[name][order]
    by_flow = [decisions[:0]] * (int(flows[-1]) + 1 if len(flows) else 0)
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        by_flow[int(flows[begin])] = decisions[begin:end]
    return by_flow


def _check(rows: Mapping[str, NDArray[np.int64]], most_flows: int, place: str) -> None:
    """Check that an emulator could have made these decisions."""
    delay, copy = rows["delay_ns"], rows["copy_delay_ns"]
    lost = np.isin(rows["fate"], _LOST)
    possible = (
        np.isin(rows["fate"], list(Fate))
        & (rows["flow"] >= 0)
        & (rows["flow"] < most_flows)
        & np.where(lost, (delay == -1) & (copy == -1), delay >= 0)
        & ((copy == -1) | (copy >= delay))
        & (np.maximum(delay, copy) <= _LONGEST_NS)
        & (rows["bit"] >= -1)
        & (rows["copy_bit"] >= -1)
    )
    if not possible.all():
        k = int(np.flatnonzero(~possible)[0])
        values = ", ".join(f"{name} {rows[name][k]}" for name in SCHEMA.names[2:])
        raise CallerError(f"{place}: impossible decision: {values}")
