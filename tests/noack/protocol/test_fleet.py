from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from noack.protocol.fleet import Fleet, FleetDecoder
from noack.protocol.machine_interface import Notice, Output, Record
from noack.protocol.wire_format import Decoder, Encoder, Flow, Message

KEY = bytes(32)


class Scripted:
    """A machine with given deadlines; a message replaces the next one by its own time."""

    def __init__(self, deadlines_ns: Sequence[int]) -> None:
        self._deadlines_ns = sorted(deadlines_ns)
        self.inputs = 0

    def next_deadline_ns(self) -> int | None:
        return self._deadlines_ns[0] if self._deadlines_ns else None

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        t_ns = self._deadlines_ns.pop(0)
        return (*self._row("timer", t_ns, now_ns), Message(Flow.UPDATE, self.inputs, t_ns, _NONE))

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        self._deadlines_ns = sorted([message.t_ns, *self._deadlines_ns[1:]])
        return self._row("message", message.t_ns, now_ns)

    def announce(self, change: Any, now_ns: int) -> Sequence[Record | Notice]:
        return (*self._row("change", change.t_ns, now_ns), Notice(now_ns, "info", "a change"))

    def _row(self, what: str, t_ns: int, now_ns: int) -> tuple[Record]:
        self.inputs += 1
        return (Record(what, (self.inputs, t_ns, now_ns)),)


_NONE = np.zeros(0)
times_ns = st.integers(0, 20)
scripts = st.lists(
    st.tuples(st.lists(times_ns, max_size=5), st.integers(0, 4)), min_size=1, max_size=6
)
inputs = st.lists(st.tuples(st.integers(0, 5), times_ns), max_size=20)


@given(scripts, inputs)
def test_a_fleet_equals_its_machines_alone(
    script: list[tuple[list[int], int]], messages: list[tuple[int, int]]
) -> None:
    """Timers are served in the order of (deadline, loop); a loop's time begins at its phase."""
    phases = [phase_ns for _, phase_ns in script]
    alone = [Scripted(deadlines) for deadlines, _ in script]
    fleet = Fleet([Scripted(deadlines) for deadlines, _ in script], phases)
    for now_ns in range(200):
        deadlines = [one.next_deadline_ns() for one in alone]
        due = [(t_ns + phases[i], i) for i, t_ns in enumerate(deadlines) if t_ns is not None]
        assert fleet.next_deadline_ns() == (min(due)[0] if due else None)
        if messages and (not due or now_ns % 2):
            loop, t_ns = messages.pop()
            loop %= len(alone)
            message = Message(Flow.UPDATE, 0, t_ns, _NONE, loop)
            outputs = fleet.handle(message, now_ns)
            expected = alone[loop].handle(message, now_ns - phases[loop])
        elif due:
            loop = min(due)[1]
            outputs = fleet.on_timer(now_ns)
            expected = alone[loop].on_timer(now_ns - phases[loop])
        else:
            break
        assert outputs == [
            Record(one.table, (loop, *one.row)) if isinstance(one, Record)
            else one._replace(loop=loop)
            for one in expected
        ]  # fmt: skip
    assert not due


class Change(NamedTuple):
    t_ns: int


def test_a_change_is_announced_to_every_machine_in_its_own_time() -> None:
    outputs = Fleet([Scripted([]), Scripted([])], [0, 2]).announce(Change(9), 7)
    assert outputs == [
        Record("change", (0, 1, 9, 7)), Notice(7, "info", "a change", 0),
        Record("change", (1, 1, 7, 5)), Notice(5, "info", "a change", 1),
    ]  # fmt: skip


@given(st.lists(st.tuples(st.integers(0, 4), st.integers(0, 9)), max_size=60))
def test_each_loop_rejects_what_is_stale_in_it(sent: list[tuple[int, int]]) -> None:
    """Loops 3 and 4 are not of the run."""
    decoder = FleetDecoder([Decoder(Flow.UPDATE, 1 + i, 1, KEY, loop=i) for i in range(3)])
    encoder, newest, expected = Encoder(1, KEY), [-1] * 3, Counter[str]()
    for loop, sequence in sent:
        dimension = 1 + loop if loop < 3 else 1
        message = Message(Flow.UPDATE, sequence, 0, np.full(dimension, 1.0 * sequence), loop)
        found = decoder.decode(encoder.encode(message))
        if loop < 3 and sequence > newest[loop]:
            assert found is not None
            assert (found.loop, found.sequence, len(found.vector)) == (loop, sequence, 1 + loop)
            newest[loop] = sequence
        else:
            assert found is None
            expected["stale" if loop < 3 else "loop"] += 1
    assert decoder.accepted == len(sent) - expected.total()
    assert decoder.report()["rejected"] == dict(expected)
    assert decoder.decode(b"short") is None
