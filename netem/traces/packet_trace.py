"""A packet trace: when each packet of a flow was sent, and when it was received, if it was.

:func:`read_trace` reads one from a file. Each format of files is a module of this folder.

Times are whole nanoseconds since the first sending. All packets are in the trace: a number that no
record has is a lost packet, for whose sending time the neighbours' are interpolated.

Between two clocks, delays are known up to a constant, and to the drift of one against the other
(:func:`relative_delays`). The lower envelope of the measured delays is the line below all of them
with the smallest mean distance to them. Its slope is the drift; without it, the smallest delay is
0. Source: Moon, Skelly, Towsley, *Estimation and removal of clock skew from network delay
measurements*, INFOCOM 1999.
"""

import gzip
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from netem.core.errors import CallerError, one_line, shortened, why
from netem.core.file_access import open_regular
from netem.traces.smallest_delays import FEWEST, envelope_slope, find_steps, steps_text

Int64s = NDArray[np.int64]
Times = NDArray[np.float64]
LOST_NS = -1
"""Receiving time of a lost packet."""
MAX_PACKETS = 50_000_000
"""Most packets of a trace."""
_MOST_MISSING = 1000
"""Most missing packets per record, of a long trace: two records must not fill the memory."""
LONGEST_NS = 10**18
"""Longest time after the first sending: 31 years."""
MOST_DRIFT_PPM = 500.0
"""Clocks differ by less than 200 ppm; NTP slews a clock by at most 500 ppm."""
_FEWEST = 20
"""With fewer packets nothing is said about the clocks."""
_HEAD_BYTES = 4096
"""Beginning of a file, by which its format is known."""
_GZIP = b"\x1f\x8b"
_SHIPPED = Path(__file__).parent / "shipped"
_LONGEST_NAME = 100
"""Longest name that is looked up among the shipped traces."""


class TraceRecordError(ValueError):
    """A record contradicts the others; ``row`` is its place among the records, from 0."""

    def __init__(self, row: int, message: str) -> None:
        super().__init__(message)
        self.row = row


@dataclass(frozen=True, eq=False)
class PacketTrace:
    """k packets of one flow; :func:`packet_trace` makes one from records."""

    sequence: Int64s  # (k,) Numbers, each greater than the one before by 1
    sent_ns: Int64s  # (k,) Since the first sending; not descending
    received_ns: Int64s  # (k,) Since the first sending; −1 for a lost packet
    notes: tuple[str, ...] = ()  # Lines for a report about how the trace was obtained
    delays_unknown: str = ""  # Why the delays are not known, and mean nothing; empty: they are known
    losses_ambiguous: str = ""  # Why the number of losses is not certain; empty: it is

    def __len__(self) -> int:
        return len(self.sequence)

    @property
    def lost(self) -> NDArray[np.bool_]:
        """(k,) Whether a packet was lost."""
        return np.equal(self.received_ns, LOST_NS)

    def noted(self, *lines: str) -> "PacketTrace":
        """Return the trace with further notes."""
        return replace(self, notes=(*self.notes, *lines))

    @property
    def delay_ns(self) -> Int64s:
        """(k,) From sending to receiving; −1 for a lost packet."""
        return np.where(self.lost, LOST_NS, self.received_ns - self.sent_ns)


def packet_trace(
    sent_ns: Int64s,
    received_ns: Int64s,
    lost: NDArray[np.bool_],
    sequence: Int64s | None = None,
    *,
    clocks_differ: bool = False,
    most_packets: int = MAX_PACKETS,
) -> PacketTrace:
    """Return a trace from n records in any order, with the missing packets added as lost.

    Args:
        sent_ns: (n,) Sending times, from any origin.
        received_ns: (n,) Receiving times; ignored for lost packets.
        lost: (n,) Which of them were lost.
        sequence: (n,) Their numbers; None: 0, 1, …
        clocks_differ: The two times were read on different clocks. The delays are then known up
            to a constant; it is chosen so that the smallest delay is 0.
        most_packets: Most packets, including missing ones.

    Raises:
        TraceRecordError: a number occurs twice, a packet was sent before its predecessor or
            received before it was sent, or a time or the number of packets is too large.
        ValueError: there are no records.
    """
    if not len(sent_ns):
        raise ValueError("has no packets")
    row = np.arange(len(sent_ns)) if sequence is None else np.argsort(sequence, kind="stable")
    number = row if sequence is None else sequence[row]
    _check_numbers(number, row, most_packets)
    sent, received, lost = sent_ns[row], received_ns[row], lost[row]
    _refuse(
        np.flatnonzero(np.diff(sent) < 0) + 1,
        row,
        "is sent before the packet that precedes it; sending times must not descend",
    )
    if int(sent[-1]) - int(sent[0]) > LONGEST_NS:
        raise TraceRecordError(int(row[-1]), "is sent more than 31 years after the first packet")
    origin_ns = sent[0]
    known = received[~lost]
    reference_ns = known[0] if clocks_differ and len(known) else origin_ns
    apart = np.abs(received // 2 - reference_ns // 2) > LONGEST_NS // 2  # halves do not overflow
    _refuse(np.flatnonzero(apart & ~lost), row, "is received 31 years from the first sending")
    sent = sent - origin_ns
    received = received - reference_ns
    if clocks_differ and len(known):
        received = received - (received - sent)[~lost].min()
    received = np.where(lost, sent, received)
    early = (
        "is received before it is sent; if two clocks were read, give --clocks different "
        "(measure), relative (words), clocks_differ = true (TOML)"
    )
    _refuse(np.flatnonzero(received < sent), row, early)
    return _with_missing(number, sent, np.where(lost, LOST_NS, received))


def _refuse(places: NDArray[np.intp], row: Int64s, message: str) -> None:
    if len(places):
        raise TraceRecordError(int(row[places[0]]), message)


def _check_numbers(number: Int64s, row: Int64s, most_packets: int) -> None:
    again = np.flatnonzero(number[1:] == number[:-1]) + 1
    _refuse(again, row, "has a sequence number that an earlier record has")
    packets = int(number[-1]) - int(number[0]) + 1
    most_packets = min(most_packets, _MOST_MISSING * (len(number) + 1000))
    if packets > most_packets:
        raise TraceRecordError(
            int(row[-1]), f"makes the trace {packets} packets long; at most {most_packets} can be"
        )


def _with_missing(number: Int64s, sent_ns: Int64s, received_ns: Int64s) -> PacketTrace:
    """Return the trace with the missing packets; ``number`` ascends."""
    index = number - number[0]
    k = int(index[-1]) + 1
    received = np.full(k, LOST_NS)
    received[index] = received_ns
    before = np.searchsorted(index, np.arange(k), side="right") - 1
    after = np.minimum(before + 1, len(index) - 1)
    gap = np.maximum(index[after] - index[before], 1)
    steps = np.arange(k) - index[before]
    each, rest = np.divmod(sent_ns[after] - sent_ns[before], gap)
    sent = sent_ns[before] + each * steps + rest * steps // gap
    return PacketTrace(np.arange(k) + number[0], sent, received)


def relative_delays(trace: PacketTrace) -> PacketTrace:
    """Return the trace with relative delays, without drift; the smallest delay is 0.

    After a step of the smallest delay they are not known.
    """
    here = np.flatnonzero(~trace.lost)
    if not len(here):
        return trace
    sent_ns = trace.sent_ns[here]
    delay_ns = trace.received_ns[here] - sent_ns
    delay_ns = delay_ns - delay_ns.min()
    steps = find_steps(sent_ns.astype(float), delay_ns.astype(float))
    if steps:
        reason = (
            f"{steps_text(steps, sent_ns)}: a clock was set, the route changed, or a queue stays full; "
            "measure the parts (editcap -A, -B), or give --clocks same if the clocks were synchronised"
        )
        return replace(trace, delays_unknown=reason).noted(f"delays are not known: {reason}")
    if len(here) < FEWEST:
        trace = trace.noted(f"fewer than {FEWEST} arrivals do not show whether a clock was set between them")
    slope = 0.0 if len(here) < _FEWEST else envelope_slope(sent_ns, delay_ns)
    is_plausible = 0 < abs(slope) <= MOST_DRIFT_PPM * 1e-6
    if is_plausible:
        delay_ns = delay_ns - np.rint(slope * sent_ns).astype(np.int64)
    received = np.full(len(trace), LOST_NS)
    received[here] = sent_ns + delay_ns - delay_ns.min()
    is_known = is_plausible or (slope == 0 and len(here) >= _FEWEST)
    return replace(trace, received_ns=received).noted(
        "the two clocks are not comparable: the smallest delay is shown as 0, the others are relative to it, "
        "and a deadline applies to these relative delays",
        f"the receiver's clock runs {slope * 1e6:+.2f} ppm against the sender's (slope of the smallest "
        "delays); this drift is removed"
        if is_known
        else "the drift between the clocks could not be estimated, and is not removed",
    )


@dataclass(frozen=True)
class TraceFormat:
    """A format of files; a module of this folder adds it by defining one."""

    name: str
    """For messages, e.g. ``CSV``."""
    recognises: Callable[[bytes], bool]
    """Whether a file that begins with these bytes has the format."""
    read: Callable[[IO[bytes], int, bool], PacketTrace]
    """Reads a file, given the most packets, and whether the clocks differ.

    Raises:
        ValueError: one line without the file's name: where, what is wrong, what would be right.
    """


def _formats() -> Sequence[TraceFormat]:
    entries = iter_modules(import_module(__package__).__path__, f"{__package__}.")
    modules = (vars(import_module(entry.name)) for entry in entries if entry.name != __name__)
    return [value for module in modules for value in module.values() if isinstance(value, TraceFormat)]


def read_trace(
    path: Path,
    *,
    place: str = "",
    clocks_differ: bool = False,
    most_packets: int = MAX_PACKETS,
    others: Sequence[str] = (),
) -> PacketTrace:
    """Return the trace in a file.

    Args:
        path: the file.
        place: what messages begin with; by default the path.
        clocks_differ: see :func:`packet_trace`.
        most_packets: most packets of the trace.
        others: what the caller reads besides; for a message.

    Raises:
        CallerError: one line; the file cannot be read, or is not a trace.
    """
    known = _formats()
    try:
        with open_regular(path) as file:
            head, file = decompressed(file)
            if not head:
                raise ValueError("is empty")
            known_format = next((candidate for candidate in known if candidate.recognises(head)), None)
            if known_format is None:
                names = ", ".join(sorted(candidate.name for candidate in known))
                raise ValueError(
                    f"not a packet trace; {names} can be read, also compressed by gzip"
                    f"{''.join(f', {other}' for other in others)}; a CSV file "
                    "begins with a header, e.g. sequence,sent_ms,received_ms"
                )
            return known_format.read(file, most_packets, clocks_differ)
    except FILE_ERRORS as error:
        raise CallerError(f"{place or path}: {file_problem(error)}") from None


def decompressed(file: IO[bytes]) -> tuple[bytes, IO[bytes]]:
    """Return how a file begins, and the file from its beginning, decompressed if necessary."""
    head = file.read(_HEAD_BYTES)
    file.seek(0)
    if not head.startswith(_GZIP):
        return head, file
    content: Any = gzip.GzipFile(fileobj=file)
    head = content.read(_HEAD_BYTES)
    content.seek(0)
    return head, content


def is_compressed(path: Path) -> bool:
    """Return whether a file is compressed by gzip."""
    with open_regular(path) as file:
        return file.read(len(_GZIP)) == _GZIP


FILE_ERRORS = (OSError, ValueError, EOFError, zlib.error)
"""What reading a file raises, compressed or not."""


def file_problem(error: Exception) -> str:
    """Return in one line what is wrong with a file."""
    if isinstance(error, EOFError | zlib.error | gzip.BadGzipFile):
        return f"cannot be decompressed: {one_line(error)}"
    return f"cannot be read: {why(error)}" if isinstance(error, OSError) else one_line(error)


def find_trace(name: str, folder: Path = Path(), named: str = "") -> Path:
    """Return the path of a trace given by path, or by the name of a shipped one.

    Args:
        name: as the user gave it.
        folder: a relative path is relative to it.
        named: what a message calls the name; by default the name.

    Raises:
        CallerError: a bare name that is neither that of a file nor that of a shipped trace.
    """
    path = folder / name
    if len(Path(name).parts) != 1 or Path(name).suffix or len(name) > _LONGEST_NAME or path.exists():
        return path
    shipped = {path.stem: path for path in _SHIPPED.glob("*/*.csv")}
    if name in shipped:
        return shipped[name]
    raise CallerError(
        f"{named or shortened(name)}: no such file, nor a shipped trace; "
        f"there are {', '.join(sorted(shipped))}"
    )
