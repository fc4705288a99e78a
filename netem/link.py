"""One direction of a link: decides each datagram's fate, flow by flow. It reads no payload.

Flows are independent of each other: each has its own loss process, random stream and MANSD counter,
so that the fates of a flow depend on the seed and on its own arrival order only.
"""

from collections.abc import Sequence
from typing import NamedTuple

from netem.loss import LossModel, loss_model
from netem.mansd import MansdCap
from noack.machine import Notice, Record
from noack.records import NETEM_PACKET, PACKET_HEAD_BYTES, Fate
from noack.rng import stream
from noack.scenario import Loss, Scenario


class Datagram(NamedTuple):
    """A datagram of a flow; flows are numbered in the order of their first datagram."""

    flow: int
    data: bytes


class _FlowState:
    def __init__(self, loss: LossModel, cap: MansdCap) -> None:
        self.loss = loss
        self.cap = cap
        self.packets = 0


class Link:
    """The machine of the network emulator.

    Args:
        loss: settings of the loss model.
        mansd: M − 1, or None for no cap.
        seed: seed of the loss streams.
        name: name of the link and direction; part of its random streams' names.
        first_delivered: pass the first datagram of each flow.
    """

    def __init__(
        self, loss: Loss, mansd: int | None, seed: int, name: str, *, first_delivered: bool = True
    ) -> None:
        self._settings = loss
        self._mansd = mansd
        self._seed = seed
        self._name = name
        self._first_delivered = first_delivered
        self._inputs = 0
        self._flows: dict[int, _FlowState] = {}

    def next_deadline_ns(self) -> int | None:
        """None: nothing is delayed."""
        return None

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Nothing is ever due."""
        return ()

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Take a datagram; return it if it survives."""
        state = self._flows.get(message.flow)
        if state is None:
            state = self._flows[message.flow] = self._new_flow(message.flow)
        fate = state.cap.decide(state.loss.lost())
        head = message.data[:PACKET_HEAD_BYTES].ljust(PACKET_HEAD_BYTES, b"\0")
        row = (
            self._inputs, state.packets, now_ns, now_ns,
            message.flow, fate, state.cap.run, len(message.data), head,
        )  # fmt: skip
        self._inputs += 1
        state.packets += 1
        record = Record(NETEM_PACKET, row)
        return (record,) if fate is Fate.DROPPED else (message, record)

    def _new_flow(self, flow: int) -> _FlowState:
        rng = stream(self._seed, "netem", self._name, "loss", str(flow))
        return _FlowState(
            loss_model(self._settings, rng),
            MansdCap(self._mansd, first_delivered=self._first_delivered),
        )


def update_link_of(resolved: Scenario) -> Link:
    """Return the link from sensor to controller of a resolved scenario."""
    network = resolved.network
    return Link(
        network.loss,
        network.mansd if network.enforce_mansd else None,
        resolved.seeds.loss,
        "update",
        first_delivered=network.initial_sync == "first_packet",
    )
