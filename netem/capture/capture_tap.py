"""The tap that hands what a relay does to a capture."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netem.capture.capture_writer import CaptureWriter
from netem.capture.pcapng import PcapngInterface
from netem.engine.relay_interface import LinkSpec
from noack.runtime.address import text_of


class CaptureTap:
    """Offers batches to a capture; both sides of each link are an interface of it.

    Args:
        writer: of a capture with the interfaces of :func:`interfaces_of`.
        links: how many links the relay has.
    """

    wants_data = True

    def __init__(self, writer: CaptureWriter, links: int) -> None:
        self._writer = writer
        self._links = links

    def take(self, events: NDArray[Any], data: NDArray[np.uint8]) -> None:
        """Offer a copy, as the relay goes on writing where these are."""
        if events.size:
            try:
                self._writer.offer(events.copy(), data.copy())
            except MemoryError:
                self.missing(len(events))

    def missing(self, events: int) -> None:
        """Count events that there was no room for; of which side is not known."""
        missed = np.zeros(2 * self._links, np.int64)
        missed[0] = events
        self._writer.miss(missed)


def interfaces_of(specs: Sequence[LinkSpec]) -> list[PcapngInterface]:
    """Return a capture's interfaces: for each link the clients' side, then the server's."""
    return [
        PcapngInterface(f"{spec.name} {side}", text_of(address))
        for spec in specs
        for side, address in (("client", spec.listen), ("server", spec.to))
    ]
