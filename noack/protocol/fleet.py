"""The machines of one role of several loops, as one machine; and their decoders, as one decoder.

Loops are numbered from 0. A message carries the number of its loop, which selects the machine.
A row of the record gets the number in front, a notice carries it. The timers are served in the
order of their deadlines, at equal times in the order of the loops.

A loop begins at its phase, a time of the run: this is its time 0. Its messages, rows and notices
have the loop's own time.
"""

from collections.abc import Sequence
from heapq import heappop, heappush
from typing import Any

from noack.protocol.machine_interface import Machine, Notice, Output, Record
from noack.protocol.wire_format import Decoder, Message, Rejection, loop_number


class Fleet:
    """The machine of a process that serves several loops.

    Args:
        machines: the machine of each loop.
        phases_ns: when each loop begins; by default 0.
    """

    def __init__(
        self, machines: Sequence[Machine[Message]], phases_ns: Sequence[int] | None = None
    ) -> None:
        self.machines = tuple(machines)
        self._phases_ns = tuple(phases_ns or (0,) * len(self.machines))
        self._deadlines_ns: list[int | None] = [None] * len(self.machines)
        self._due: list[tuple[int, int]] = []
        """A heap of deadlines with their loops; only its first entry is never outdated."""
        for loop in range(len(self.machines)):
            self._update(loop)

    def next_deadline_ns(self) -> int | None:
        """The earliest deadline of all machines, in the time of the run."""
        return self._due[0][0] if self._due else None

    def handle(self, message: Message, now_ns: int) -> Sequence[Output]:
        """Pass a message to the machine of its loop."""
        loop = message.loop
        outputs = self.machines[loop].handle(message, now_ns - self._phases_ns[loop])
        self._update(loop)
        return [of_loop(loop, output) for output in outputs]

    def on_timer(self, now_ns: int) -> Sequence[Output]:
        """Do the work of the one machine whose deadline is the earliest."""
        loop = self._due[0][1]
        outputs = self.machines[loop].on_timer(now_ns - self._phases_ns[loop])
        self._update(loop)
        return [of_loop(loop, output) for output in outputs]

    def announce(self, change: Any, now_ns: int) -> Sequence[Record | Notice]:
        """Announce a change of settings to every machine; its time is that of the run."""
        outputs: list[Record | Notice] = []
        for loop, (machine, phase_ns) in enumerate(
            zip(self.machines, self._phases_ns, strict=True)
        ):
            own = change._replace(t_ns=max(change.t_ns - phase_ns, 0))
            announced = machine.announce(own, now_ns - phase_ns)  # type: ignore[attr-defined]
            outputs += [of_loop(loop, output) for output in announced]
        return outputs

    def _update(self, loop: int) -> None:
        """Note a machine's next deadline."""
        deadline_ns = self.machines[loop].next_deadline_ns()
        if deadline_ns is not None:
            deadline_ns += self._phases_ns[loop]
        if deadline_ns == self._deadlines_ns[loop]:
            return
        self._deadlines_ns[loop] = deadline_ns
        due = self._due
        if deadline_ns is not None:
            heappush(due, (deadline_ns, loop))
        while due and self._deadlines_ns[due[0][1]] != due[0][0]:
            heappop(due)


class FleetDecoder:
    """Decodes the datagrams of several loops, each by the decoder of its loop.

    A datagram without a loop of the run goes to the first decoder, which rejects and counts it.
    """

    def __init__(self, decoders: Sequence[Decoder]) -> None:
        self.decoders = tuple(decoders)

    @property
    def accepted(self) -> int:
        """Number of accepted datagrams."""
        return sum(one.accepted for one in self.decoders)

    @property
    def rejected(self) -> dict[Rejection, int]:
        """Number of rejected datagrams, by reason."""
        return {reason: sum(one.rejected[reason] for one in self.decoders) for reason in Rejection}

    def decode(self, datagram: bytes, *, from_peer: bool = True) -> Message | None:
        """Return the message, or None if the decoder of its loop rejects the datagram."""
        loop = loop_number(datagram) or 0
        decoder = self.decoders[loop if loop < len(self.decoders) else 0]
        return decoder.decode(datagram, from_peer=from_peer)

    def report(self) -> dict[str, object]:
        """Counters of all loops together, for the run's summary."""
        rejected = {reason.value: n for reason, n in self.rejected.items() if n}
        return {"accepted": self.accepted, "rejected": rejected, "loops": self.reports()}

    def reports(self) -> list[dict[str, object]]:
        """Counters of each loop."""
        return [one.report() for one in self.decoders]


def of_loop(loop: int, output: Any) -> Any:
    """Return an output of a loop's machine with the number of the loop."""
    if type(output) is Record:
        return Record(output.table, (loop, *output.row))
    return output._replace(loop=loop)
