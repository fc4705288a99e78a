"""The network's word on each update, without a network."""

from collections.abc import Callable

from netem.link import Datagram, update_link_of
from noack.scenario import Scenario


def network_fates(resolved: Scenario) -> Callable[[int], bool]:
    """Whether the scenario's network delivers update i, for i = 0, 1, …: as in a live run.

    The emulator's decisions depend on its seed and on the order of arrival only, so that they are
    known before anything is sent. For ``initial_sync = "first_packet"`` update 0 is delivered.
    """
    link = update_link_of(resolved)
    known: list[bool] = []

    def delivered(event: int) -> bool:
        while len(known) <= event:
            outputs = link.handle(Datagram(0, b""), 0)
            known.append(any(isinstance(output, Datagram) for output in outputs))
        return known[event]

    return delivered
