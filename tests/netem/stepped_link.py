"""One direction of a link to which a test gives one datagram at a time."""

from collections.abc import Sequence
from typing import Any

from netem.impairments.link_settings import Counters, LinkSettings
from netem.link_state import LinkState
from noack.machines.run_channel import Datagram, RunChannel, UserNetwork
from noack.protocol.roles import Notice, Record
from tests.noack.machines.stepped_channel import SteppedChannel


class Link:
    """A channel of one direction.

    Args:
        settings: the settings; they must not name files.
        seed: seed of its random streams.
        name: names of the link and the direction; part of its random streams' names.
        flows: number of flows that :meth:`handle` takes.
        network: decides instead of the impairments; the guarantee is that of the settings.
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        *name: str,
        flows: int = 8,
        network: UserNetwork | None = None,
    ) -> None:
        self.state = LinkState(settings, seed, *name, rows=flows, any_order=network is not None)
        self._channel = SteppedChannel(RunChannel([self.state], loops=flows, network=network))
        self._started = flows

    @property
    def counters(self) -> Counters:
        """Counts so far."""
        return self.state.counters

    def flow(self, flow: int) -> Any:
        """The state of a flow, a ``noack_flow``."""
        return self.state.flow(flow)

    def change(self, settings: LinkSettings) -> None:
        """Apply other settings."""
        self._channel.channel.change(settings)

    def decide(self, flow: int, size_bytes: int, now_ns: int) -> Any:
        """Decide for a flow's next packet; the next call overwrites the ``noack_decision``."""
        for number in range(self._started, flow + 1):
            self.state.start_flow(number, number)
        self._started = max(self._started, flow + 1)
        return self.state.decide(flow, size_bytes, now_ns)

    def next_deadline_ns(self) -> int | None:
        """Time of the next departure; None: nothing is in flight."""
        return self._channel.next_deadline_ns()

    def on_timer(self, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Forward the datagram that is due."""
        return self._channel.on_timer(now_ns)

    def handle(self, message: Datagram, now_ns: int) -> Sequence[Datagram | Record | Notice]:
        """Process a datagram; return it if it is neither lost nor delayed."""
        return self._channel.handle(message, now_ns)
