"""A relay without sockets, of which a test sets the reports; and terminals."""

import argparse
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from netem.control.command_queue import CommandQueue
from netem.core.address import Address
from netem.core.core_library import core
from netem.impairments.link_settings import Counters, LinkSettings
from netem.relay.relay import Relay
from netem.relay.relay_links import LinkSpec
from netem.relay.relay_reports import DIRECTIONS, Direction, DirectionReport, FlowReport, LinkReport
from netem.relay_watch import add_watching_options, check_watching_options
from netem.tc_words import settings_of

SETTINGS = settings_of("loss 10% delay 10ms mansd 2")
HERE: Address = ("127.0.0.1", 5000)
THERE: Address = ("::1", 6000)


def spec_of(name: str) -> LinkSpec:
    return LinkSpec(name, HERE, THERE, SETTINGS, LinkSettings())


def times(*t_ns: int) -> NDArray[np.int64]:
    buckets = [core.noack_bucket_of(one_ns) for one_ns in t_ns]
    return np.bincount(np.array(buckets, np.int64), minlength=core.NOACK_BUCKETS)


class FakeRelay(Relay):
    """A relay without sockets; a test sets its links and counters."""

    def __init__(self, *names: str) -> None:
        self.specs: Sequence[LinkSpec] = [spec_of(name) for name in names]
        self.counters = {(name, side): Counters() for name in names for side in DIRECTIONS}
        self.settings = {(spec.name, side): getattr(spec, side) for spec in self.specs for side in DIRECTIONS}
        self.unintended: dict[str, int] = {"lost_in_kernel": 0, "send_errors": 0}
        self.delays = times()
        self.lateness = times()
        self.flows: list[FlowReport] = []
        self.changes = 0
        self.threads: set[int] = set()
        """The threads that have read or changed the relay."""

    def run(self, stop: Callable[[], bool], housekeeping: Callable[[], None]) -> None:
        pause = threading.Event()
        while not stop():
            housekeeping()
            pause.wait(0.002)

    def change(self, link: str, direction: Direction, settings: LinkSettings) -> None:
        self.threads.add(threading.get_ident())
        self.settings[link, direction] = settings
        self.changes += 1

    def report(self) -> Sequence[LinkReport]:
        self.threads.add(threading.get_ident())
        return [
            LinkReport(
                spec.name, spec.listen, spec.to, 1, 3, 0, 0, 0,
                self._direction(spec.name, "forward"), self._direction(spec.name, "reverse"),
            )
            for spec in self.specs
        ]  # fmt: skip

    def _direction(self, link: str, direction: Direction) -> DirectionReport:
        counters = replace(self.counters[link, direction])
        return DirectionReport(
            self.settings[link, direction], counters, dict(self.unintended), 5,
            list(self.flows), self.delays.copy(), self.lateness.copy(),
        )  # fmt: skip


def options(*arguments: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_watching_options(parser)
    given = parser.parse_args(arguments)
    check_watching_options(given)
    return given


@contextmanager
def running(relay: Relay) -> Iterator[CommandQueue]:
    """Run a relay in a separate thread."""
    commands, stopping = CommandQueue(relay), threading.Event()
    thread = threading.Thread(target=relay.run, args=(stopping.is_set, commands.run_pending))
    thread.start()
    try:
        yield commands
    finally:
        stopping.set()
        thread.join()
        commands.close()
