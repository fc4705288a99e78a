"""What other threads ask of the relay's thread, which does it between two batches of datagrams.

The packet path waits for nobody: statistics, live control and the view have threads of their own,
and all that they need of the relay is done here, in microseconds.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, replace
from functools import cached_property
from queue import SimpleQueue
from threading import Lock
from typing import Any, NamedTuple, TypeVar

from netem.engine.relay_interface import Direction, LinkReport, Relay
from netem.loss_prediction import predicted_loss
from netem.words.words_to_settings import text_of
from noack.core.errors import PeerError
from noack.impairments.link_records import Counters
from noack.impairments.link_settings import LinkSettings

T = TypeVar("T")

_PATIENCE_S = 5.0


@dataclass(frozen=True)
class AppliedSettings:
    """What a direction of a link does, and since when."""

    settings: LinkSettings
    since: Counters
    """Its counters when these settings came into force."""

    @cached_property
    def words(self) -> str:
        """The settings in the words of ``tc netem``."""
        return text_of(self.settings)

    @cached_property
    def predicted_loss(self) -> float | None:
        """See :mod:`netem.loss_prediction`; this may take seconds."""
        return predicted_loss(self.settings)


class Snapshot(NamedTuple):
    """What has happened in a relay until now."""

    engine: str
    links: Sequence[LinkReport]
    in_force: Mapping[tuple[str, Direction], AppliedSettings]
    elapsed_ns: int
    """Since the relay began."""
    unix_ns: int


class CommandQueue:
    """Does in the relay's thread what other threads ask for.

    Args:
        relay: the relay.
    """

    def __init__(self, relay: Relay) -> None:
        self._relay = relay
        self._began_ns = time.monotonic_ns()
        self._waiting: SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = SimpleQueue()
        self._in_force: dict[tuple[str, Direction], AppliedSettings] = {}
        for spec in relay.specs:
            self._in_force[spec.name, "forward"] = AppliedSettings(spec.forward, Counters())
            self._in_force[spec.name, "back"] = AppliedSettings(spec.back, Counters())
        self._closed = False
        self._lock = Lock()

    @property
    def links(self) -> Sequence[str]:
        """Names of the relay's links."""
        return [spec.name for spec in self._relay.specs]

    def run(self) -> None:
        """Do what is waiting; called in the relay's thread, at least every 50 ms."""
        for _ in range(self._waiting.qsize()):
            future, do = self._waiting.get_nowait()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(do())
            except Exception as error:
                future.set_exception(error)

    def close(self) -> None:
        """Refuse what is asked from now on; called in the relay's thread when the relay ends."""
        with self._lock:
            self._closed = True
        while not self._waiting.empty():
            self._waiting.get_nowait()[0].cancel()

    def ask(self, do: Callable[[], T]) -> T:
        """Have something done in the relay's thread, from another one, and return its result.

        Raises:
            PeerError: the relay has ended, or does not answer.
        """
        future: Future[T] = Future()
        with self._lock:
            if self._closed:
                raise PeerError("the emulator has ended")
            self._waiting.put((future, do))
        try:
            return future.result(_PATIENCE_S)
        except CancelledError:
            raise PeerError("the emulator has ended") from None
        except TimeoutError:
            if future.done():  # it was the errand's own
                raise
            future.cancel()
            raise PeerError(f"the emulator has not answered for {_PATIENCE_S:g} s") from None

    def snapshot(self) -> Snapshot:
        """Return what has happened, from another thread.

        Raises:
            PeerError: the relay has ended, or does not answer.
        """
        return self.ask(self.look)

    def look(self) -> Snapshot:
        """Return what has happened; in the relay's thread, or when the relay has ended."""
        return Snapshot(
            self._relay.engine,
            self._relay.report(),
            dict(self._in_force),
            time.monotonic_ns() - self._began_ns,
            time.time_ns(),
        )

    def change(self, link: str, directions: Sequence[Direction], settings: LinkSettings) -> None:
        """Change directions of a link, from another thread.

        Raises:
            CallerError: the relay refuses the settings.
            PeerError: the relay has ended, or does not answer.
        """

        def do() -> None:
            for direction in directions:
                self._relay.change(link, direction, settings)
            (report,) = (one for one in self._relay.report() if one.name == link)
            for direction in directions:
                changed = report.forward if direction == "forward" else report.back
                self._in_force[link, direction] = AppliedSettings(
                    settings, replace(changed.counters)
                )

        self.ask(do)
