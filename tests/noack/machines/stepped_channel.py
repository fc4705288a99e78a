"""The network of a run to which a test gives one datagram at a time, instead of a driver in C."""

from collections.abc import Callable, Sequence

from netem.core.clock import NEVER_NS
from netem.core.packet_rows import PACKET_HEAD_BYTES
from noack.core.core_library import core, ffi
from noack.machines.channel import Channel
from noack.machines.run_channel import Datagram, RunChannel
from noack.protocol.roles import Notice, Record
from noack.scenario.parameter_changes import ParameterChange

_UNKNOWN_NS = 2**62
"""An arrival at the socket that is later than its handling is unknown."""


def send(channel: Channel, flow: int, number: int, size_bytes: int, now_ns: int, error_level: int) -> None:
    """Let a channel take a packet as :meth:`Channel.send` does, with a header if it is long enough."""
    head = b"NA\x01\x02\x09" + bytes([error_level])
    datagram = ffi.new("noack_datagram *", {
        "flow": flow, "size_bytes": size_bytes, "arrival_ns": now_ns, "bit": -1, "head": head,
        "message": {"sequence": number},
    })  # fmt: skip
    channel._departures(lambda: int(core.noack_channel_handle(channel.core, datagram, now_ns)))


class SteppedChannel:
    """A channel with payloads."""

    def __init__(self, channel: RunChannel) -> None:
        self.channel, self._handled = channel, 0
        self._payloads: dict[int, bytes] = {}
        self._copies: dict[int, int] = {}  # delayed copies of each payload

    def announce(self, change: ParameterChange, now_ns: int) -> Sequence[Record | Notice]:
        return self.channel.announce(change, now_ns)

    def next_deadline_ns(self) -> int | None:
        """Time of the next departure in either direction; None: nothing is in flight."""
        return None if (due_ns := self.channel.due_ns) == NEVER_NS else due_ns

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Process a datagram; return it if it is neither lost nor delayed."""
        channel, number, data = self.channel.core, self._handled, message.data
        assert 0 <= message.flow < channel.loops * len(self.channel.links)
        datagram = ffi.new("noack_datagram *", {
            "flow": message.flow, "size_bytes": len(data), "arrival_ns": _UNKNOWN_NS,
            "bit": -1, "head": data[:PACKET_HEAD_BYTES], "message": {"sequence": number},
        })  # fmt: skip
        before = channel.delayed_count
        self._payloads[number] = data
        outputs = self._step(lambda: int(core.noack_channel_handle(channel, datagram, now_ns)))
        self._handled += 1
        self._copies[number] = channel.delayed_count - before - channel.leaving_count
        self._forget(number)
        return outputs

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Forward the datagram that is due; if one is due in each direction, the first one."""
        channel = self.channel.core
        outputs = self._step(lambda: int(core.noack_channel_release(channel, now_ns)))
        number = channel.leaving[0].message.sequence
        self._copies[number] -= 1
        self._forget(number)
        return outputs

    def _step(self, step: Callable[[], int]) -> Sequence[Datagram | Record | Notice]:
        """Make a step; return the datagrams that leave, and its row."""
        channel = self.channel.core
        while (question := step()) != core.NOACK_DONE:
            if question == core.NOACK_ASK_OUTCOME:
                self.channel.decide(self._payloads[channel.asked.message.sequence])
            else:
                self.channel.answer(question)
        leaving = (channel.leaving[index] for index in range(channel.leaving_count))
        datagrams = [
            Datagram(departure.flow, flipped(self._payloads[departure.message.sequence], departure.bit))
            for departure in leaving
        ]
        batches = self.channel.take_rows()
        rows = [Record(table, row) for table, batch in batches for row in batch.tolist()]
        return (*datagrams, *rows)

    def _forget(self, number: int) -> None:
        """Forget a payload after its last departure."""
        if not self._copies[number]:
            del self._copies[number], self._payloads[number]


def flipped(data: bytes, bit: int) -> bytes:
    """The data with one bit flipped; bit 0 is the least significant bit of byte 0; -1: none."""
    if bit < 0:
        return data
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << (bit % 8)
    return bytes(changed)
