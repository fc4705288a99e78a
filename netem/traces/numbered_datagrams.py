"""The packets of a flow whose payloads have a sequence number at a known place."""

import heapq
import re
from array import array
from typing import NamedTuple

import numpy as np

from netem.core.row_operations import firsts_of_equal
from netem.traces.captured_datagrams import CapturedDatagram, CapturedFlow
from netem.traces.captured_flows import Capture
from netem.traces.merged_datagrams import pieces_of
from netem.traces.packet_trace import Int64s
from netem.traces.sequence_numbers import Arrivals, find_packets, nearest_steps
from netem.traces.smallest_delays import FEWEST

_FIELD = re.compile(r"([0-9]{1,5}):([1-8])(:little)?")
_MOST_UNREADABLE = 0.01
_LONGEST_LOOKED_AT = 64
"""The longest datagrams, by which merging is recognised."""
_CERTAIN_BITS = 40
"""Bits of consecutive numbers in pieces that are no coincidence."""
_MOST_LOST_BETWEEN = 64
"""Largest step between the numbers of two pieces."""
_MOST_OF_OTHER_CONTENT = 0.6
"""Two counters have equal numbers in half of the datagrams; with more, it is no number."""
_FEWEST_STEPS = 20
"""With fewer steps nothing is said about their size."""
_MOST_MISSING = 0.9
"""Share of missing numbers between packets above which others have them: the counter is shared."""
_RANGE = re.compile(r"([0-9]{1,20})\.\.([0-9]{1,20})")
_MOST_NUMBERS = 2**62
_MOST_OF_OTHER_SESSIONS = 0.05
"""Share of the datagrams that short sessions may have, to be left out."""


class SequenceField(NamedTuple):
    """Where a payload has its sequence number."""

    offset: int
    size_bytes: int
    is_little: bool
    low_bits: int | None = None  # The number is in the lowest bits of the field; None: in all
    first: int = 0  # The numbers count from here
    last: int | None = None  # To here, and then from the first again; None: as far as the bits go

    @classmethod
    def parse(cls, text: str, bits: int | None = None, numbers: str | None = None) -> "SequenceField":
        """Parse ``OFFSET:BYTES`` or ``OFFSET:BYTES:little``, and a range ``FIRST..LAST``.

        Raises:
            ValueError: one line; it begins with the option.
        """
        match = _FIELD.fullmatch(text)
        if match is None:
            raise ValueError(
                "--sequence-at: expected OFFSET:BYTES with 1 to 8 bytes, e.g. 2:2 for RTP, or 8:4:little; "
                f"found {text!r}"
            )
        field = cls(int(match[1]), int(match[2]), match[3] is not None)
        if bits is not None:
            if not 2 <= bits <= field.bits:
                raise ValueError(f"--bits: expected 2 to {field.bits}, the bits of the field; found {bits}")
            field = field._replace(low_bits=bits)
        if numbers is not None:
            ends = _RANGE.fullmatch(numbers)
            first, last = (int(ends[1]), int(ends[2])) if ends else (0, 0)
            if not 0 <= first < last - 1 < 2**field.bits - 1 or last - first >= _MOST_NUMBERS:
                raise ValueError(
                    f"--numbers: expected FIRST..LAST, at most {2**field.bits - 1}, with three numbers or "
                    f"more, e.g. 1..255; found {numbers!r}"
                )
            field = field._replace(first=first, last=last)
        return field

    @property
    def bits(self) -> int:
        """The bits of the numbers."""
        return self.low_bits or 8 * self.size_bytes

    @property
    def size(self) -> int:
        """How many different numbers there are."""
        return (1 << self.bits) - self.first if self.last is None else self.last - self.first + 1

    @property
    def kind(self) -> str:
        """The numbers in words."""
        return f"of {self.bits} bits" if self.last is None else f"{self.first}..{self.last}"

    def read(self, payload: bytes) -> int | None:
        """Return the number, counted from the first one; None if the payload is too short.

        A number outside the range is ``size`` or more.
        """
        part = payload[self.offset : self.offset + self.size_bytes]
        if len(part) < self.size_bytes:
            return None
        number = int.from_bytes(part, "little" if self.is_little else "big") & ((1 << self.bits) - 1)
        return number - self.first if number >= self.first else self.size

    def numbers_of(self, payload: bytes, size_bytes: int, largest_step: int) -> list[int] | None:
        """Return the numbers of a payload's pieces; None if they do not ascend in steps up to the largest."""
        numbers: list[int] = []
        for piece in pieces_of(payload, size_bytes):
            number = self.read(piece)
            if number is None or number >= self.size:
                return None
            if numbers and not 1 <= (number - numbers[-1]) % self.size <= largest_step:
                return None
            numbers.append(number)
        return numbers

    def __str__(self) -> str:
        return f"{self.offset}:{self.size_bytes}{':little' if self.is_little else ''}"


class NumberedPackets(NamedTuple):
    """The k packets of a flow that arrived, the first arrival of each, in the order of arrival."""

    packet: Int64s  # (k,) From 0, without wrap-around; parts follow each other without a gap
    part: Int64s  # (k,) 0, and one more after each restart of the sender
    received_ns: Int64s
    row: Int64s  # Numbers of the datagrams in the order of the file
    period_ns: float
    ambiguous: str = ""  # Why the number of losses is not certain; empty: it is


class _Numbers(NamedTuple):
    number: np.ndarray
    t_ns: Int64s
    row: Int64s


def number_packets(
    capture: Capture, flow: CapturedFlow, field: SequenceField, rows: Int64s | None = None
) -> NumberedPackets:
    """Return the packets of a flow, and note what is unusual about its numbers.

    Args:
        capture: the capture.
        flow: the flow.
        field: where the numbers are.
        rows: the datagrams, by their places in the file; None: all of the flow.

    Raises:
        ValueError: there are no sequence numbers, or too many datagrams are cut before them.
    """
    numbers = _read_numbers(capture, flow, field, rows)
    if len(numbers.number) < 2:
        raise ValueError(f"fewer than two datagrams have a sequence number at {field}")
    numbers = _without_end(capture, numbers, field)
    _check_steps(capture, numbers, field)
    try:
        found = find_packets(numbers.number, numbers.t_ns, field.bits, field.size)
    except ValueError as error:
        raise ValueError(
            f"the numbers at {field} {error}; check --sequence-at, or filter the capture"
        ) from None
    notes = capture.notes
    strays = len(numbers.number) - len(found.arrival)
    if strays:
        notes.append(f"datagrams left out because their number does not belong to the sequence: {strays}")
    found = _without_short_parts(capture, found)
    packet = found.packet.copy()
    start = 0
    for part in range(int(found.part[-1]) + 1):
        here = found.part == part
        if part:
            at_s = (numbers.t_ns[found.arrival[np.flatnonzero(here)[0]]] - numbers.t_ns[0]) / 1e9
            notes.append(
                f"the sender restarted at {at_s:.6g} s: its numbers do not go on there, and no losses are "
                "counted at this place"
            )
        packet[here] += start - packet[here].min()
        start = int(packet[here].max()) + 1
    numbered = NumberedPackets(
        packet, found.part, numbers.t_ns[found.arrival], numbers.row[found.arrival], found.period_ns
    )
    numbered = _first_of_each(capture, numbered)
    _check_shared(numbered, field)
    if not found.uncertain:
        return numbered
    ambiguous = _ambiguity(numbered, found, field)
    notes.append(ambiguous)
    return numbered._replace(ambiguous=ambiguous)


def _without_end(capture: Capture, numbers: _Numbers, field: SequenceField) -> _Numbers:
    """Return numbers in which a negative one at the end (iperf2) is positive, and not repeated."""
    number = numbers.number
    last = int(number[-1])
    first = len(number) - int(np.argmin(np.append(number[::-1] == last, False)))
    ended = field.size - last
    if field.low_bits or field.last is not None or first == 0:
        return numbers
    step = ended - int(number[first - 1])
    if not 0 < step <= _MOST_LOST_BETWEEN or not ended < last:
        return numbers
    repeats = len(number) - first - 1
    capture.notes.append(
        f"the number at the end is negative, as iperf2 ends a stream: it counts as {ended}"
        f"{f', once; it is repeated {repeats} times' if repeats else ''}"
    )
    number = number.copy()
    number[first] = ended
    return _Numbers(*(column[: first + 1] for column in (number, *numbers[1:])))


def _without_short_parts(capture: Capture, found: Arrivals) -> Arrivals:
    """Return the arrivals without those of sessions that are too short to be measured beside the others."""
    sizes = np.bincount(found.part)
    is_short = sizes < FEWEST
    short = int(sizes[is_short].sum())
    if not 0 < short <= _MOST_OF_OTHER_SESSIONS * len(found.part):
        return found
    capture.notes.append(f"datagrams left out because they belong to another, short session: {short}")
    kept = ~is_short[found.part]
    places = np.cumsum(kept) - 1
    return found._replace(
        arrival=found.arrival[kept],
        packet=found.packet[kept],
        part=(np.cumsum(~is_short) - 1)[found.part[kept]],
        uncertain=tuple(
            gap._replace(place=int(places[gap.place])) for gap in found.uncertain if kept[gap.place]
        ),
    )


def _ambiguity(numbered: NumberedPackets, found: Arrivals, field: SequenceField) -> str:
    """Return how many packets may be lost, if numbers may have wrapped around in gaps."""
    lost = start = 0
    for part in range(int(numbered.part[-1]) + 1):
        here = numbered.packet[numbered.part == part]
        lost += int(here.max()) - start + 1 - len(here)
        start = int(here.max()) + 1
    fewest = lost - field.size * sum(gap.wraps for gap in found.uncertain)
    most = lost + field.size * sum(gap.most - gap.wraps for gap in found.uncertain)
    assumed = "the sender paused there" if lost == fewest else "the sender went on there"
    return (
        f"gaps in which the numbers {field.kind} may have wrapped around: {len(found.uncertain)}. The "
        f"numbers do not say how often: {fewest} packets are lost if the sender paused in all of them, "
        f"{most} if it went on; {lost} is for the case that {assumed}"
    )


def _check_shared(numbered: NumberedPackets, field: SequenceField) -> None:
    """Refuse numbers of which most are missing all the time: they count more than this flow."""
    packet = np.sort(numbered.packet)
    if len(packet) < _FEWEST_STEPS:
        return
    steps = np.diff(packet)
    usual = steps[steps <= 2 * np.quantile(steps, 0.75)]  # without outages
    missing = 1 - len(usual) / float(usual.sum())
    if missing > _MOST_MISSING and int(np.gcd.reduce(steps)) == 1:
        raise ValueError(
            f"{100 * missing:.0f} % of the numbers at {field} are missing: they count more than this flow, "
            "as a counter for all receivers of a sender does; capture at both ends"
        )


def _first_of_each(capture: Capture, numbered: NumberedPackets) -> NumberedPackets:
    """Return the first arrival of each packet, and note the others."""
    order = np.argsort(numbered.packet, kind="stable")
    places = firsts_of_equal(numbered.packet[order])
    first = order[places]
    duplicates = len(order) - len(first)
    if duplicates:
        hashes = np.zeros(len(capture.datagrams.row), np.int64)
        hashes[capture.datagrams.row] = capture.datagrams.hashes
        of_arrival = hashes[numbered.row[order]]
        of_first = np.repeat(of_arrival[places], np.diff(places, append=len(order)))
        others = int(np.count_nonzero(of_arrival != of_first))
        if others > _MOST_OF_OTHER_CONTENT * len(order):
            raise ValueError(
                f"{others} of {len(order)} datagrams have the number of an earlier one, but another content: "
                "they have no sequence number there; check --sequence-at"
            )
        if duplicates > others:
            capture.notes.append(f"duplicates: {duplicates - others}; the first counts")
        if others:
            capture.notes.append(
                f"datagrams with the number of an earlier one, but another content: {others}; the flow "
                "seems to have two counters, or no number there; filter the capture, or check --sequence-at"
            )
    first = np.sort(first)
    packet, part, received_ns, row = (column[first] for column in numbered[:4])
    return numbered._replace(packet=packet, part=part, received_ns=received_ns, row=row)


def _check_steps(capture: Capture, numbers: _Numbers, field: SequenceField) -> None:
    """Refuse numbers in the wrong byte order, and note those that rise in equal steps above 1."""
    steps = nearest_steps(numbers.number, field.size)
    steps = steps[steps != 0]
    if len(steps) < _FEWEST_STEPS:
        return
    if field.bits > 8 and float((steps % 256 == 0).mean()) > 0.9:
        other = str(field._replace(is_little=not field.is_little))
        raise ValueError(
            f"the numbers at {field} rise by multiples of 256, as in the wrong byte order; "
            f"try --sequence-at {other}"
        )
    divisor = int(np.gcd.reduce(steps))
    if divisor > 1:
        capture.notes.append(
            f"all numbers differ by multiples of {divisor}: the numbers between them count as lost, which is "
            f"wrong if the sender counts in steps of {divisor}, or if they are times; check --sequence-at"
        )


def _read_numbers(
    capture: Capture, flow: CapturedFlow, field: SequenceField, rows: Int64s | None = None
) -> _Numbers:
    """Return the numbers of a flow in the order of arrival, merged datagrams divided."""
    longest: list[tuple[int, int, bytes]] = []
    numbers, columns = array("Q"), (array("q"), array("q"))
    cut = short = outside = 0
    chosen = None if rows is None else frozenset(rows.tolist())
    for row, datagram in enumerate(capture.read()):
        if datagram.flow != flow or (chosen is not None and row not in chosen):
            continue
        number = field.read(datagram.payload)
        if number is None:
            cut += datagram.is_cut
            short += not datagram.is_cut
            continue
        if number >= field.size:
            outside += 1
            continue
        numbers.append(number)
        columns[0].append(datagram.t_ns)
        columns[1].append(row)
        if not datagram.is_cut:
            entry = (len(datagram.payload), -row, datagram.payload)
            (heapq.heappush if len(longest) < _LONGEST_LOOKED_AT else heapq.heappushpop)(longest, entry)
    if cut > _MOST_UNREADABLE * (cut + len(numbers)):
        raise ValueError(
            f"{cut} of {cut + len(numbers)} datagrams are cut before their sequence number{capture.problem()}"
        )
    if cut:
        capture.notes.append(f"cut before their sequence number, so they seem to be lost: {cut}")
    if short:
        capture.notes.append(
            f"datagrams left out because they are too short for a number at {field}: {short}"
        )
    if outside > _MOST_UNREADABLE * (outside + len(numbers)):
        raise ValueError(
            f"{outside} of {outside + len(numbers)} numbers at {field} are not in {field.kind}; "
            "check --numbers"
        )
    if outside:
        capture.notes.append(f"datagrams left out because their number is not in {field.kind}: {outside}")
    read = _Numbers(np.array(numbers, np.uint64), *(np.array(column, np.int64) for column in columns))
    size_bytes = _merged_size([payload for _, _, payload in longest], field)
    if size_bytes:
        read = _divided(capture, flow, field, size_bytes)
    order = np.argsort(read.t_ns, kind="stable")
    return _Numbers(*(column[order] for column in read))


def _merged_size(longest: list[bytes], field: SequenceField) -> int:
    """Return the size of the datagrams that were merged into the longest ones; 0: none were."""
    most = max(map(len, longest), default=0)
    needed = 0.8 * len(longest)
    for size_bytes in range(field.offset + field.size_bytes, most):
        merged = [payload for payload in longest if len(payload) > size_bytes]
        bits = field.bits * sum(-(-len(payload) // size_bytes) - 1 for payload in merged)
        if bits < _CERTAIN_BITS or len(merged) < needed / 4:
            continue
        wrong, most_wrong = 0, 0.2 * len(merged)
        for payload in merged:
            wrong += field.numbers_of(payload, size_bytes, 1) is None
            if wrong > most_wrong:
                break
        else:
            return size_bytes
    return 0


def _divided(capture: Capture, flow: CapturedFlow, field: SequenceField, size_bytes: int) -> _Numbers:
    """Return the numbers of a flow with datagrams of more than a size divided."""
    numbers, columns = array("Q"), (array("q"), array("q"))
    merged = 0
    for row, datagram in enumerate(capture.read()):
        if datagram.flow == flow:
            parts = _numbers_of(datagram, field, size_bytes)
            merged += len(parts) > 1
            for number in parts:
                numbers.append(number)
                columns[0].append(datagram.t_ns)
                columns[1].append(row)
    capture.notes.append(
        f"datagrams that the kernel merged (UDP GRO): {merged}, divided into pieces of {size_bytes} bytes"
    )
    return _Numbers(np.array(numbers, np.uint64), *(np.array(column, np.int64) for column in columns))


def _numbers_of(datagram: CapturedDatagram, field: SequenceField, size_bytes: int) -> list[int]:
    if not datagram.is_cut and len(datagram.payload) > size_bytes:
        numbers = field.numbers_of(datagram.payload, size_bytes, _MOST_LOST_BETWEEN)
        if numbers is not None:
            return numbers
    number = field.read(datagram.payload)
    return [] if number is None or number >= field.size else [number]
