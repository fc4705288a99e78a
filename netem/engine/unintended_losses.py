"""Unintended losses: no setting caused them. They void the guarantee and are always reported."""

import errno
import os
from collections import Counter
from collections.abc import Mapping

from netem.engine.relay_interface import Direction
from netem.standard_error import say

KERNEL = "lost_in_kernel"
_HOW = {
    KERNEL: "were lost in the kernel, as its receive buffer was full",
    os.strerror(errno.ENOBUFS): "were lost, as a queue on the way out was full",
    os.strerror(errno.ENOMEM): "were lost, as there was no memory to delay them",
}


class UnintendedLosses:
    """Unintended losses of one direction of a link.

    Args:
        link: the link's name.
        direction: the direction.
    """

    def __init__(self, link: str, direction: Direction) -> None:
        self._where = f"link {link}, {direction}"
        self._counts: Counter[str] = Counter({KERNEL: 0})
        self._told: Counter[str] = Counter()

    def lost_in_kernel(self, datagrams: int) -> None:
        """Set the total number of datagrams that the kernel has dropped."""
        self._set(KERNEL, datagrams)

    def not_sent(self, error: int, datagrams: int) -> None:
        """Set the total number of datagrams that could not be sent or stored, for one errno."""
        self._set(os.strerror(error), datagrams)

    def counts(self) -> Mapping[str, int]:
        """Return the number of losses by cause."""
        return dict(self._counts)

    def tell(self) -> None:
        """Report the totals that have changed since the last call on standard error."""
        for what, datagrams in self._counts.items():
            if datagrams > self._told[what]:
                self._told[what] = datagrams
                how = _HOW.get(what, f"could not be sent ({what})")
                say(f"{self._where}: {datagrams} datagrams {how}, against the guarantee")

    def _set(self, what: str, datagrams: int) -> None:
        if datagrams > 0:
            self._counts[what] = datagrams
            if not self._told[what]:
                self.tell()
