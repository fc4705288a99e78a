"""The queue by which other threads reach a relay.

:class:`CommandQueue` runs commands in the relay's thread between two batches of datagrams: the
packet path never waits, and each command takes microseconds.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, replace
from functools import cached_property
from queue import SimpleQueue
from threading import Lock
from typing import NamedTuple, TypeVar

from netem.core.errors import PeerError
from netem.impairments.link_settings import Counters, LinkSettings
from netem.impairments.markov_chain import NotPredictableError
from netem.impairments.target_loss import expected_loss, loss_process
from netem.relay.relay import Relay
from netem.relay.relay_reports import DIRECTIONS, Direction, LinkReport
from netem.relay.timetable import TimedChange
from netem.tc_words import words_of

T = TypeVar("T")

_PATIENCE_S = 5.0
"""Longest wait for the relay's thread, which runs commands every 50 ms."""


@dataclass(frozen=True)
class AppliedSettings:
    """The settings of a direction, and its counters when they were applied."""

    settings: LinkSettings
    since: Counters

    @cached_property
    def words(self) -> str:
        """The settings in the words of ``tc netem``."""
        return words_of(self.settings)

    @cached_property
    def predicted_loss(self) -> float | None:
        """See :mod:`netem.impairments.loss_prediction`; this may take seconds."""
        return expected_loss(self.settings).rate

    @cached_property
    def loss_variance(self) -> float | None:
        """Variance of the number of losses among n packets, divided by n; None: it is not known."""
        try:
            return loss_process(self.settings).outcomes(self.settings.guarantee).variance
        except NotPredictableError:
            return None


class Snapshot(NamedTuple):
    """The state of a relay at one time."""

    links: Sequence[LinkReport]
    applied: Mapping[tuple[str, Direction], AppliedSettings]
    elapsed_ns: int
    """Time since the relay was opened, shortly before it runs."""
    unix_ns: int


class CommandQueue:
    """Runs commands of other threads in the relay's thread."""

    def __init__(self, relay: Relay) -> None:
        self._relay = relay
        self._began_ns = time.monotonic_ns()
        self._waiting: SimpleQueue[tuple[Callable[[], None], Callable[[], bool]]] = SimpleQueue()
        """What runs a command, and what cancels it."""
        self._applied: dict[tuple[str, Direction], AppliedSettings] = {
            (spec.name, direction): AppliedSettings(getattr(spec, direction), Counters())
            for spec in relay.specs
            for direction in DIRECTIONS
        }
        relay.on_timed_change = self._note_timed_change
        self._closed = False
        self._lock = Lock()

    def _note_timed_change(self, change: TimedChange, counters: Counters) -> None:
        self._applied[change.link, change.direction] = AppliedSettings(change.settings, counters)

    @property
    def links(self) -> Sequence[str]:
        """Names of the relay's links."""
        return [spec.name for spec in self._relay.specs]

    def run_pending(self) -> None:
        """Run the submitted commands; called in the relay's thread, at least every 50 ms."""
        for _ in range(self._waiting.qsize()):
            run, _ = self._waiting.get_nowait()
            run()

    def close(self) -> None:
        """Refuse further commands; called in the relay's thread when the relay ends."""
        with self._lock:
            self._closed = True
        while not self._waiting.empty():
            _, cancel = self._waiting.get_nowait()
            cancel()

    def submit(self, command: Callable[[], T]) -> T:
        """Run a command in the relay's thread, from another thread, and return its result.

        Raises:
            PeerError: the relay has ended, or does not answer.
        """
        future: Future[T] = Future()

        def run() -> None:
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(command())
                except Exception as error:
                    future.set_exception(error)

        with self._lock:
            if self._closed:
                raise PeerError("the emulator has ended")
            self._waiting.put((run, future.cancel))
        try:
            return future.result(_PATIENCE_S)
        except CancelledError:
            raise PeerError("the emulator has ended") from None
        except TimeoutError:
            if future.done():  # the command itself raised it
                raise
            future.cancel()
            raise PeerError(f"the emulator has not answered for {_PATIENCE_S:g} s") from None

    def snapshot(self) -> Snapshot:
        """Return the state of the relay, from another thread.

        Raises:
            PeerError: the relay has ended, or does not answer.
        """
        return self.submit(self.snapshot_here)

    def snapshot_here(self) -> Snapshot:
        """Return the state of the relay, in its thread or after its end."""
        return Snapshot(
            self._relay.report(),
            dict(self._applied),
            time.monotonic_ns() - self._began_ns,
            time.time_ns(),
        )

    def change(self, link: str, changes: Mapping[Direction, LinkSettings]) -> None:
        """Change directions of a link between two datagrams, from another thread.

        Raises:
            CallerError: the relay refuses the settings.
            PeerError: the relay has ended, or does not answer.
        """

        def command() -> None:
            for direction, settings in changes.items():
                self._relay.change(link, direction, settings)
            (report,) = (link_report for link_report in self._relay.report() if link_report.name == link)
            for direction, settings in changes.items():
                counters = replace(getattr(report, direction).counters)
                self._applied[link, direction] = AppliedSettings(settings, counters)

        self.submit(command)
