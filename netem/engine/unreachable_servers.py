"""Servers whose port is unreachable according to ICMP."""

from netem.engine.relay_interface import LinkSpec
from netem.standard_error import say
from noack.runtime.address import text_of


class UnreachableServers:
    """Reports once, on standard error, that the server of a link is unreachable.

    Args:
        spec: the link.
    """

    def __init__(self, spec: LinkSpec) -> None:
        self._spec = spec
        self._told = False

    def seen(self, answers: int) -> None:
        """Set the total number of ICMP port-unreachable messages from the server's host."""
        if answers and not self._told:
            self._told = True
            say(
                f"link {self._spec.name}: nothing listens on {text_of(self._spec.to)} "
                "(ICMP port unreachable); what is sent there is lost"
            )
