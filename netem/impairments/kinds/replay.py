"""Replay of a packet trace; see native/impairments/replay.c."""

from bisect import bisect_left
from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from netem.core.clock import NS_PER_S
from netem.core.named_file import NamedFile
from netem.core.settings_section import Probability
from netem.impairments.clauses import Clause, FileOr, Part, flag
from netem.impairments.feature import (
    LONGEST_NS,
    FileFeature,
    Impairment,
    PacketOrder,
    Stage,
    StageTables,
    add_numbers,
)
from netem.impairments.markov_chain import NotPredictableError, PeriodicLosses
from netem.impairments.trace_offset import OFFSET, Offset, offset_meaning, offset_ns, require_inside
from netem.impairments.words import OWN_TIME_NS, PERCENT, Quantity, brief_number, brief_percent, time_ns_text
from netem.traces.packet_trace import LOST_NS, PacketTrace, find_trace, read_trace

MOST_RECORDS = 1_000_000
LONGEST_DELAY_NS = 3600 * NS_PER_S


def _read_records(word: str) -> tuple[list[int], list[int]]:
    sent_ns, delays_ns = [], []
    for part in word.split(","):
        sent, _, delay = part.partition("+")
        sent_ns.append(OWN_TIME_NS.read(sent))
        delays_ns.append(LOST_NS if delay == "lost" else OWN_TIME_NS.read(delay))
    return sent_ns, delays_ns


def _write_records(records: tuple[Sequence[int], Sequence[int]]) -> str:
    return ",".join(
        f"{time_ns_text(sent_ns)}+{'lost' if delay_ns < 0 else time_ns_text(delay_ns)}"
        for sent_ns, delay_ns in zip(*records, strict=True)
    )


_RECORDS = Quantity(
    "records of sending time and delay, in whole ns, e.g. 0ms+12ms,50ms+lost",
    _read_records,
    _write_records,
)
_BY = Quantity("packet or time", str)
_Records = Annotated[tuple[int, ...], Field(min_length=1, max_length=MOST_RECORDS)]


class Replay(FileFeature, Impairment):
    """Replays a packet trace: each packet is lost or delayed as a recorded packet was."""

    kind: Literal["replay"] = "replay"
    file: Annotated[str, Field(min_length=1)] | None = None
    """The trace, e.g. CSV with the columns sequence, sent_ms and received_ms; or the name of
    a shipped one."""
    sent_ns: _Records | None = None
    """Instead of a file: sending times since the first, which is 0."""
    delays_ns: _Records | None = None
    """Instead of a file: the delay of each packet; −1 for a lost packet."""
    by: Literal["packet", "time"] = "packet"
    """packet: packet k of a flow gets record k. time: a packet gets what was recorded at its time
    since the emulator's start (in a run: its epoch)."""
    repeat: bool = True
    """false: after the trace's end, packets pass without delay."""
    offset_s: Offset = 0.0
    """Begin at this time of the trace, in seconds; random: at a time that the seed chooses."""
    delay_share: Probability = 1.0
    """This share of each recorded delay is applied, e.g. 0.5 for one way of round-trip times."""
    clocks_differ: bool = False
    """true: the file's sending and receiving times are of different clocks. The delays are then
    counted from the smallest one."""

    clauses: ClassVar = (
        Clause(
            "replay",
            "replay trace.csv",
            FileOr(
                "sent_ns delays_ns",
                _RECORDS,
                "T+T,T+lost,...",
                "records",
                "replay records 0ms+12ms,50ms+lost",
                expected="a file with a packet trace",
            ),
            Part("by", _BY, "packet|time", "by", "replay trace.csv by time"),
            Part("offset_s", OFFSET, "T|random", "from", "replay trace.csv from random"),
            Part("delay_share", PERCENT, "P", "share", "replay trace.csv share 50%"),
            flag("relative", "replay trace.csv relative", "clocks_differ", True),
            flag("once", "replay trace.csv once", "repeat", False),
        ),
    )
    delays: ClassVar = True
    tc_missing: ClassVar = "traces of packets"

    @model_validator(mode="after")
    def _check(self) -> Self:
        sent_ns, delays_ns = self.sent_ns, self.delays_ns
        if (sent_ns is None) != (delays_ns is None) or (self.file is None) == (sent_ns is None):
            raise ValueError("file: a replay needs a file, or both sent_ns and delays_ns")
        if sent_ns is None or delays_ns is None:
            return self
        if self.clocks_differ:
            raise ValueError("clocks_differ: goes with a file")
        if len(sent_ns) != len(delays_ns):
            raise ValueError(f"delays_ns: has {len(delays_ns)} records, sent_ns {len(sent_ns)}")
        sent, delays = np.array(sent_ns, object), np.array(delays_ns, object)
        if sent_ns[0] != 0 or sent_ns[-1] > LONGEST_NS or (sent[1:] < sent[:-1]).any():
            raise ValueError("sent_ns: must begin with 0, must not descend, and end within 31 years")
        if ((delays < LOST_NS) | (delays > LONGEST_DELAY_NS)).any():
            raise ValueError(f"delays_ns: must be -1 to {LONGEST_DELAY_NS}, one hour")
        require_inside(self.offset_s, self.length_ns)
        return self

    @property
    def length_ns(self) -> int:
        """Length of a trace that has been read: a mean interval beyond the last sending."""
        sent_ns = self.sent_ns or (0,)
        return max(sent_ns[-1] + sent_ns[-1] // max(len(sent_ns) - 1, 1), 1)

    @property
    def longest_s(self) -> float:
        return max(0, *self.delays_ns or (0,), 0) * self.delay_share / NS_PER_S

    @property
    def _loses(self) -> bool:
        return self.delays_ns is not None and min(self.delays_ns) < 0

    @property
    def prediction_note(self) -> str:
        return "" if self.repeat else "while the trace lasts"

    def order_after(self, before: PacketOrder) -> PacketOrder:
        varies = self.delays_ns is None or len(set(self.delays_ns) - {LOST_NS}) > 1
        return PacketOrder(delayed=True, reordered=before.reordered or varies)

    def meaning(self) -> str:
        recording = self.file
        if self.delays_ns is not None:
            lost = sum(delay < 0 for delay in self.delays_ns) / len(self.delays_ns)
            recording = (
                f"{len(self.delays_ns)} packets in {brief_number(self.length_ns / NS_PER_S)} s, "
                f"{brief_percent(lost)} lost, delays up to {brief_number(self.longest_s)} s"
            )
        matching = "at its time since the start" if self.by == "time" else "by its number in its flow"
        repetition = ", repeated" if self.repeat else ", once"
        share = "" if self.delay_share == 1 else f", with {brief_percent(self.delay_share)} of the delay"
        return (
            f"loses or delays each packet as recorded {matching}{share}: "
            f"{recording}{offset_meaning(self.offset_s)}{repetition}"
        )

    def stage(self, tables: StageTables) -> Stage:
        self.require_content()
        times_begin, _ = add_numbers(tables.integers, self.sent_ns or ())
        begin, end = add_numbers(tables.integers, self._stage_delays_ns())
        first_ns = offset_ns(self.offset_s, self.length_ns, tables)
        by_time = self.by == "time"
        numbers = {
            "begin": begin,
            "end": end,
            "times_begin": times_begin,
            "offset": first_ns if by_time else bisect_left(self.sent_ns or (), first_ns),
            "period_ns": self.length_ns if by_time else 0,
            "once": int(not self.repeat),
        }
        return Stage(self.kind, numbers)

    def _stage_delays_ns(self) -> Sequence[int]:
        """Return the delays as a stage has them: a lost packet has that of its predecessor."""
        stage_delays_ns: list[int] = []
        latest_ns = 0
        for delay_ns in self.delays_ns or ():
            if delay_ns >= 0:
                latest_ns = delay_ns if self.delay_share == 1 else round(delay_ns * self.delay_share)
            stage_delays_ns.append(latest_ns if delay_ns >= 0 else -1 - latest_ns)
        return stage_delays_ns

    def chains(self) -> Sequence[PeriodicLosses]:
        self.require_content(NotPredictableError)
        if not self._loses:
            return ()
        if self.by == "time":
            raise NotPredictableError("recorded losses by time depend on when packets arrive")
        if not self.repeat:
            raise NotPredictableError("a trace that is replayed once has no long-run loss rate")
        lost = np.array(self.delays_ns) < 0
        if self.offset_s == "random":
            return (PeriodicLosses(lost, begin=None),)
        first_ns = round(self.offset_s * NS_PER_S)
        return (PeriodicLosses(np.roll(lost, -bisect_left(self.sent_ns or (), first_ns))),)

    def read_file(self, file: NamedFile) -> Self:
        path = find_trace(file.name, file.folder, file.named)
        trace = read_trace(
            path, place=file.named, clocks_differ=self.clocks_differ, most_packets=MOST_RECORDS
        )
        return self.with_trace(trace, file)

    def with_trace(self, trace: PacketTrace, file: NamedFile) -> Self:
        """Return the settings with a trace, which was in a file."""
        if trace.delays_unknown:
            file.wrong(f"cannot be replayed: delays are not known: {trace.delays_unknown}")
        if (trace.delay_ns > LONGEST_DELAY_NS).any():
            file.wrong("has a delay of more than an hour; a replay can have none")
        update = {
            "sent_ns": tuple(trace.sent_ns.tolist()),
            "delays_ns": tuple(trace.delay_ns.tolist()),
            "file": None,
            "clocks_differ": False,
        }
        replay = self.model_copy(update=update)
        require_inside(self.offset_s, replay.length_ns, file)
        return replay
