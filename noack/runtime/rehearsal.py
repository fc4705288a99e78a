"""Rehearses the rare path of a process, so that it is in the processor's caches when needed.

Events come every few seconds. Meanwhile the code that handles them leaves the caches, and then
takes several times as long. Therefore sensor and controller send themselves a message between two
steps of the loop, through a second socket. A copy of the machine receives it, and sends its answer
to the same socket. Nothing of it is recorded or reaches another process.
"""

import math
import time
from typing import Any

import numpy as np

from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.protocol.machine_interface import Machine
from noack.protocol.wire_format import Encoder, Flow, Message
from noack.runtime.udp_sockets import MessageSocket
from noack.settings.named_file import file_tables

PERIOD_S = 0.002
POSTPONED_S = 0.02
_ROLES = ("sensor", "controller")
_DISTANCE = 1e3
"""Distance of two successive rehearsed states: a measurement so far from the model is an event."""


class Rehearsal:
    """The copies of one process.

    Args:
        machine: a machine of its own.
        channel: a channel that sends to itself.
        encoder: encodes what the channel receives.
        receives: the flow that it receives.
        entries: length of that flow's vectors.
    """

    def __init__(
        self,
        machine: Machine[Message],
        channel: MessageSocket,
        encoder: Encoder,
        receives: Flow,
        entries: int,
    ) -> None:
        self._machine, self._channel, self._encoder = machine, channel, encoder
        self._receives, self._vector = receives, np.full(entries, _DISTANCE)
        self._next_s = 0.0
        self._rehearsals = self._cpu_ns = 0
        self._began_ns = time.monotonic_ns()

    def postpone(self) -> None:
        """Rehearse no more for a while: the process has just done what is rehearsed."""
        self._next_s = max(self._next_s, time.monotonic() + POSTPONED_S)

    def rehearse(self) -> None:
        """Rehearse once, unless the last time was a moment ago.

        An error, such as an overflow of the copy's model, ends the rehearsals, not the run.
        """
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = now_s + PERIOD_S
        began_ns = time.thread_time_ns()
        try:
            with np.errstate(all="ignore"):
                self._pass_message(self._rehearsals)
            self._rehearsals += 1
        except Exception:
            self._next_s = math.inf
        self._cpu_ns += time.thread_time_ns() - began_ns

    def _pass_message(self, number: int) -> None:
        self._vector = -self._vector
        t_ns = int(number * PERIOD_S * NS_PER_S)
        message = Message(self._receives, number, t_ns, self._vector)
        self._channel.put(self._encoder.encode(message))
        received = self._channel.receive(self._channel.watched[-1])
        if received is not None:
            for output in self._machine.handle(received, t_ns):
                if isinstance(output, Message):
                    self._channel.send(output)

    def report(self) -> dict[str, Any]:
        """Number of rehearsals, and their share of a core's time."""
        wall_ns = time.monotonic_ns() - self._began_ns
        return {"rehearsals": self._rehearsals, "cpu_share": self._cpu_ns / max(wall_ns, 1)}

    def close(self) -> None:
        """Close the socket."""
        self._channel.close()


def can_rehearse(role: str, scenario: Scenario) -> bool:
    """Whether a process of a scenario rehearses.

    A user's code is not called for it, and neither are acknowledgements.
    """
    own = any(place != "plant.system" for place, _ in file_tables(scenario))
    return (
        role in _ROLES and scenario.realtime.rehearse and not own
        and not scenario.protocol.acknowledges
    )  # fmt: skip
