"""Warnings of a link on standard error.

They are refused clients, an unreachable server, and unintended losses.
"""

import errno
import os
from collections import Counter
from collections.abc import Mapping

from netem.core.address import address_text
from netem.core.number_format import counted
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import Direction, report_line

KERNEL = "lost_in_kernel"
_CAUSES = {
    KERNEL: "were lost in the kernel, as its receive buffer was full",
    os.strerror(errno.ENOBUFS): "were lost, as a queue on the way out was full",
    os.strerror(errno.ENOMEM): "were lost, as there was no memory to delay them",
}


class LinkWarnings:
    """Refused clients and the unreachable server of a link; each reason is reported once."""

    def __init__(self, spec: LinkSpec) -> None:
        self._spec = spec
        self._reported: set[str] = set()

    def report_full(self) -> None:
        """Report that the link has its maximum number of clients."""
        self._report(f"at most {counted(self._spec.most_clients, 'client')} can be served at once")

    def report_flood(self, flows: int) -> None:
        """Report that other hosts, outside a shell, have begun the flows that they may begin."""
        self._report(
            f"a flood from outside: other hosts have begun {flows} flows; their further ones are "
            "refused, those that begin inside pass"
        )

    def report_no_descriptor(self, clients: int) -> None:
        """Report that no file descriptor is left for a client in addition to those present."""
        self._report(
            f"no file descriptors are left for more than {counted(clients, 'client')}; "
            "raise the limit (ulimit -n)"
        )

    def set_port_unreachable(self, answers: int) -> None:
        """Set the total number of ICMP port-unreachable messages from the server's host."""
        if answers:
            self._report(
                f"nothing listens on {address_text(self._spec.to)} (ICMP port unreachable); "
                "what is sent there is lost"
            )

    def _report(self, reason: str) -> None:
        if reason not in self._reported:
            self._reported.add(reason)
            report_line(f"link {self._spec.name}: {reason}")


class UnintendedLosses:
    """Losses that no setting caused, in one direction of a link.

    They void the guarantee and are always reported.
    """

    def __init__(self, link: str, direction: Direction) -> None:
        self._where = f"link {link}, {direction}"
        self._counts: Counter[str] = Counter({KERNEL: 0})
        self._reported: Counter[str] = Counter()

    def set_lost_in_kernel(self, datagrams: int) -> None:
        """Set the total number of datagrams that the kernel has dropped."""
        self._set(KERNEL, datagrams)

    def set_not_sent(self, error: int, datagrams: int) -> None:
        """Set the total number of datagrams that could not be sent or stored, for one errno."""
        self._set(os.strerror(error), datagrams)

    def counts(self) -> Mapping[str, int]:
        """Return the number of losses by cause."""
        return dict(self._counts)

    def report(self) -> None:
        """Report the totals that have changed since the last call on standard error."""
        for cause, datagrams in self._counts.items():
            if datagrams > self._reported[cause]:
                self._reported[cause] = datagrams
                text = _CAUSES.get(cause, f"could not be sent ({cause})")
                report_line(f"{self._where}: {counted(datagrams, 'datagram')} {text}; the guarantee is void")

    def _set(self, cause: str, datagrams: int) -> None:
        if datagrams > 0:
            self._counts[cause] = datagrams
            if not self._reported[cause]:
                self.report()
