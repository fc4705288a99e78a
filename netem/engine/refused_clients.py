"""Refused clients, and the reasons."""

import errno

from netem.engine.relay_interface import LinkSpec
from netem.standard_error import say

_OUT_OF_FILES = (errno.EMFILE, errno.ENFILE)

STOPPED_NS = 1_000_000_000
"""An engine that has not checked for idle clients for this time was stopped, or got no CPU time."""


class RefusedClients:
    """Refused clients of one link; each reason is reported once on standard error.

    Args:
        spec: the link.
    """

    def __init__(self, spec: LinkSpec) -> None:
        self._spec = spec
        self._full = False
        self._told: set[str] = set()

    def accepts(self, clients: int) -> bool:
        """Whether a client is accepted in addition to ``clients`` present ones."""
        if clients >= self._spec.most_clients:
            self._fill(f"no more than {self._spec.most_clients} clients at once are served")
        return not self._full

    def is_exhausted(self, error: int, clients: int) -> bool:
        """Whether an errno means that no file descriptor is left; if so, refuse further clients."""
        if error in _OUT_OF_FILES:
            self._fill(
                f"no file descriptors are left for more than {clients} clients; raise the limit "
                "(ulimit -n)"
            )
        return error in _OUT_OF_FILES

    def end(self) -> None:
        """Accept clients again, after one has been removed."""
        self._full = False

    def _fill(self, why: str) -> None:
        self._full = True
        if why not in self._told:
            self._told.add(why)
            say(f"link {self._spec.name}: {why}")
