"""Reads fate traces: the decisions that a link repeats in a replay."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError, model_validator

from netem.engine.relay_interface import DIRECTIONS, Direction
from netem.fates.fate_trace import FORMAT, METADATA, SCHEMA
from noack.core.errors import CallerError, one_line
from noack.impairments.constraints import require_consistent
from noack.impairments.link_settings import Constraints, Mansd, RecordedDecision
from noack.impairments.loss_guarantee import LossHistory
from noack.protocol.record_tables import Fate

_LONGEST_NS = 2**62
"""Maximum delay: its sum with a time fits into 64 bits."""
_LOST = (Fate.DROPPED, Fate.OVERFLOWED, Fate.BLACKED_OUT)


class Fates(NamedTuple):
    """The content of a trace, for each direction of each link."""

    decisions: Mapping[tuple[str, Direction], Sequence[Sequence[RecordedDecision]]]
    """Decisions of each flow, in packet order."""
    guarantees: Mapping[tuple[str, Direction], Mapping[str, Any]]
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
            known = ", ".join(links_recorded)
            raise CallerError(f"{path}: has no link {link!r}; its links: {known}")
    columns = {name: table[name].to_numpy() for name in SCHEMA.names}
    found: dict[tuple[str, Direction], Sequence[Sequence[RecordedDecision]]] = {}
    guarantees: dict[tuple[str, Direction], Mapping[str, Any]] = {}
    for link in links_recorded if links is None else links:
        for direction in DIRECTIONS:
            here = (columns["link"] == link) & (columns["direction"] == direction)
            rows = {name: column[here] for name, column in columns.items()}
            found[link, direction] = _flows(rows, len(table), f"{path}: {link} {direction}")
            given: _Direction = getattr(settings[link], direction)
            guarantees[link, direction] = dict(given) if _is_kept(given, rows) else {}
    return Fates(found, guarantees)


def _is_kept(settings: "_Direction", rows: Mapping[str, NDArray[Any]]) -> bool:
    """Whether the losses of each flow are allowed, not counting those out of order."""
    losses = rows["consecutive_losses"]
    if settings.mansd is not None and losses.max(initial=0) > settings.mansd:
        return False
    if not settings.constraints:
        return True
    rules = [one.rule for one in settings.constraints]
    histories: dict[int, LossHistory] = {}
    order = np.lexsort((rows["packet"], rows["flow"]))
    flows, lost = rows["flow"][order].tolist(), (losses > 0)[order].tolist()
    return not any(
        histories.setdefault(flow, LossHistory(rules)).add(one)
        for flow, one in zip(flows, lost, strict=True)
    )


@contextmanager
def opened_fates(path: Path) -> Iterator[tuple[pq.ParquetFile, Mapping[str, "_Link"]]]:
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
    with opened_fates(path) as (file, links):
        table = file.read()
        table.validate(full=True)
    if any(column.null_count for column in table.columns):
        raise _missing(path, "some")
    return table, links


def _missing(path: Path, count: int | str) -> CallerError:
    return CallerError(
        f"{path}: {count} events are missing; an incomplete trace cannot be replayed"
    )


class _Direction(BaseModel):
    mansd: Mansd | None
    constraints: Constraints = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_consistent(self.mansd, self.constraints)
        return self


class _Link(BaseModel):
    name: str
    forward: _Direction
    reverse: _Direction


class _Header(BaseModel):
    format: int
    version: str


class _Document(_Header):
    """The part of a trace's metadata that a replay needs."""

    missing_events: Annotated[int, Field(ge=0)]
    links: list[_Link]


def _document(path: Path, text: bytes | None) -> _Document:
    try:
        header = _Header.model_validate_json(text or b"", strict=True)
        if header.format != FORMAT:
            raise CallerError(f"{path}: has the format of noack {header.version}; record it again")
        return _Document.model_validate_json(text or b"", strict=True)
    except ValidationError:
        raise CallerError(f"{path}: not a fate trace of this program") from None


def _flows(
    rows: Mapping[str, NDArray[Any]], most_flows: int, place: str
) -> Sequence[Sequence[RecordedDecision]]:
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
    names = ("fate", "delay_ns", "copy_delay_ns", "bit", "copy_bit")
    columns = [rows[name][order].tolist() for name in names]
    decisions = [RecordedDecision(*values) for values in zip(*columns, strict=True)]
    found: list[Sequence[RecordedDecision]] = [()] * (int(flows[-1]) + 1 if len(flows) else 0)
    for begin, end in zip(begins.tolist(), ends.tolist(), strict=True):
        found[int(flows[begin])] = decisions[begin:end]
    return found


def _check(rows: Mapping[str, NDArray[Any]], most_flows: int, place: str) -> None:
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
        what = ", ".join(f"{name} {rows[name][k]}" for name in SCHEMA.names[2:])
        raise CallerError(f"{place}: impossible decision: {what}")
