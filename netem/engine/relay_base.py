"""What both engines have in common."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np

from netem.engine.link_listeners import open_links
from netem.engine.link_warnings import LinkWarnings, UnintendedLosses
from netem.engine.relay_interface import (
    DIRECTIONS,
    Address,
    Direction,
    DirectionReport,
    LinkReport,
    LinkSpec,
)
from netem.engine.relay_sockets import raise_file_limit
from noack.core.errors import CallerError
from noack.impairments.link_settings import LinkSettings
from noack.runtime.udp_sockets import drops_of

_PERIOD_NS = 40_000_000
RARE_PERIOD_NS = 250_000_000
STALL_NS = 1_000_000_000
"""An engine that has not checked for idle clients for this time was stopped, or got no CPU time."""
REPORTED_FLOWS = 16
_HEADROOM_BYTES = 48 * 1024 * 1024
"""Reserve for everything but delayed datagrams. malloc serves blocks of this size from the system,
not from its heap, and returns them to the system when they are freed."""


def has_headroom(wanted_bytes: int = 0) -> bool:
    """Whether ``wanted_bytes`` and the headroom can be allocated; the check takes microseconds."""
    try:
        np.empty(_HEADROOM_BYTES + wanted_bytes, np.uint8)
    except MemoryError:
        return False
    return True


class Relay(ABC):
    """An engine with its links; all of it is called in one thread.

    Directions are numbered: 2·link forward, 2·link + 1 reverse.

    Raises:
        CallerError: a socket cannot be bound, or a link is invalid.
    """

    engine: str
    """``batched`` or ``plain``."""
    began_unix_ns: int | None = None
    """Unix time at which it started to run; the origin of its times, including blackouts."""

    def __init__(self, specs: Sequence[LinkSpec]) -> None:
        self.specs: Sequence[LinkSpec] = tuple(specs)
        raise_file_limit()
        self._open_links = open_links(self.specs)
        self._warnings = [LinkWarnings(spec) for spec in self.specs]
        self._losses = [UnintendedLosses(spec.name, one) for spec in specs for one in DIRECTIONS]
        self._epoch_ns = 0

    def addresses(self) -> Mapping[str, Address]:
        """Return the address at which each link listens."""
        return {link.spec.name: link.address for link in self._open_links}

    def run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        """Relay until ``stop()``; both are called at least every 50 ms, in this thread."""
        if self.began_unix_ns is None:
            self._epoch_ns, self.began_unix_ns = time.monotonic_ns(), time.time_ns()
        while not stop():
            housekeeping()
            now_ns = self._now_ns()
            self._keep_house(now_ns)
            self._relay_until(now_ns + _PERIOD_NS)
        self._end()

    def change(self, link: str, direction: Direction, settings: LinkSettings) -> None:
        """Change a direction's impairments between two datagrams.

        Flows keep their numbers, the positions in their random streams, and their counters. Packets
        in flight leave at their planned times.

        Raises:
            CallerError: there is no such link.
        """
        names = [spec.name for spec in self.specs]
        if link not in names:
            raise CallerError(f"link {link}: there is none of this name, but {', '.join(names)}")
        self._change(2 * names.index(link) + DIRECTIONS.index(direction), settings)

    def report(self) -> Sequence[LinkReport]:
        """Return the counts so far."""
        self._update_losses()
        reports = []
        for number, link in enumerate(self._open_links):
            clients, clients_ever, refused, port_unreachable = self._link_counts(number)
            reports.append(
                LinkReport(
                    link.spec.name, link.address, link.spec.to, clients, clients_ever, refused,
                    link.discarded, port_unreachable,
                    self._report_direction(2 * number), self._report_direction(2 * number + 1),
                )
            )  # fmt: skip
        return reports

    def close(self) -> None:
        """Close all sockets."""
        for link in self._open_links:
            link.close()

    def _now_ns(self) -> int:
        return time.monotonic_ns() - self._epoch_ns

    def _end(self) -> None:
        self._update_losses()
        for losses in self._losses:
            losses.report()

    def _update_losses(self) -> None:
        for number, link in enumerate(self._open_links):
            *_, port_unreachable = self._link_counts(number)
            self._warnings[number].port_unreachable(port_unreachable)
            self._losses[2 * number].lost_in_kernel(drops_of(link.endpoint) or 0)
            self._losses[2 * number + 1].lost_in_kernel(self._path_drops(number))
        for direction, error, datagrams in self._send_errors():
            self._losses[direction].not_sent(error, datagrams)

    @abstractmethod
    def _keep_house(self, now_ns: int) -> None:
        """Remove idle clients, open return paths again, check for losses."""

    @abstractmethod
    def _relay_until(self, until_ns: int) -> None:
        """Relay datagrams, and pass their events to the taps."""

    @abstractmethod
    def _change(self, direction: int, settings: LinkSettings) -> None: ...

    @abstractmethod
    def _link_counts(self, link: int) -> tuple[int, int, int, int]:
        """Return present clients, all clients, refused datagrams, ICMP port-unreachable errors."""

    @abstractmethod
    def _path_drops(self, link: int) -> int:
        """Return the number of datagrams that the kernel dropped at a link's return paths."""

    @abstractmethod
    def _send_errors(self) -> Iterator[tuple[int, int, int]]:
        """Yield direction, errno and number of datagrams that could not be sent or stored."""

    @abstractmethod
    def _report_direction(self, direction: int) -> DirectionReport: ...
