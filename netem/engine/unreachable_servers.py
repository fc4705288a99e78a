"""Servers that are not there, as far as ICMP says so."""

from netem.engine.relay_interface import LinkSpec
from netem.standard_error import say
from noack.runtime.address import text_of


class UnreachableServers:
    """What a link knows of its server's absence; said once, on standard error.

    Args:
        spec: the link.
    """

    def __init__(self, spec: LinkSpec) -> None:
        self._spec = spec
        self._told = False

    def seen(self, answers: int) -> None:
        """Say how often the server's machine has answered so far that nobody listens."""
        if answers and not self._told:
            self._told = True
            say(
                f"link {self._spec.name}: nothing listens on {text_of(self._spec.to)} "
                "(ICMP port unreachable); what is sent there is lost"
            )
