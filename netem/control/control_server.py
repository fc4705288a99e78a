"""Commands of other threads, which the relay's thread runs between two batches of datagrams.

The packet path never waits: statistics, live control and the live screen have their own threads,
and each command takes microseconds.
"""

import json
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import cached_property
from queue import SimpleQueue
from threading import Lock
from typing import Any, Literal, NamedTuple, Self, TypeVar

import zenoh
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from zenoh import CongestionControl, Priority
from zenoh.handlers import RingChannel

from netem.control.emulator_session import EMULATORS, published
from netem.control.emulator_statistics import Statistics, StatisticsThread
from netem.relay import Relay
from netem.relay_links import DIRECTIONS, Direction, LinkReport
from netem.tc_words import settings_of, text_of
from noack.config.validation_messages import brief
from noack.core.errors import CallerError, MachineError, NoackError, PeerError
from noack.impairments.kept_loss import expected_loss, with_kept_loss
from noack.impairments.link_records import Counters
from noack.impairments.link_settings import LinkSettings
from noack.runtime.zenoh_session import cause_of, open_session

T = TypeVar("T")

_PATIENCE_S = 5.0


@dataclass(frozen=True)
class AppliedSettings:
    """The settings of a direction, and its counters when they were applied."""

    settings: LinkSettings
    since: Counters

    @cached_property
    def words(self) -> str:
        """The settings in the words of ``tc netem``."""
        return text_of(self.settings)

    @cached_property
    def predicted_loss(self) -> float | None:
        """See :mod:`noack.impairments.loss_prediction`; this may take seconds."""
        return expected_loss(self.settings).rate


class Snapshot(NamedTuple):
    """The state of a relay at one time."""

    links: Sequence[LinkReport]
    in_force: Mapping[tuple[str, Direction], AppliedSettings]
    elapsed_ns: int
    """Time since the relay started."""
    unix_ns: int


class CommandQueue:
    """Runs commands of other threads in the relay's thread."""

    def __init__(self, relay: Relay) -> None:
        self._relay = relay
        self._began_ns = time.monotonic_ns()
        self._waiting: SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = SimpleQueue()
        self._in_force: dict[tuple[str, Direction], AppliedSettings] = {
            (spec.name, direction): AppliedSettings(getattr(spec, direction), Counters())
            for spec in relay.specs
            for direction in DIRECTIONS
        }
        self._closed = False
        self._lock = Lock()

    @property
    def links(self) -> Sequence[str]:
        """Names of the relay's links."""
        return [spec.name for spec in self._relay.specs]

    def run_pending(self) -> None:
        """Run the submitted commands; called in the relay's thread, at least every 50 ms."""
        for _ in range(self._waiting.qsize()):
            future, command = self._waiting.get_nowait()
            if not future.set_running_or_notify_cancel():
                continue
            try:
                future.set_result(command())
            except Exception as error:
                future.set_exception(error)

    def close(self) -> None:
        """Refuse further commands; called in the relay's thread when the relay ends."""
        with self._lock:
            self._closed = True
        while not self._waiting.empty():
            self._waiting.get_nowait()[0].cancel()

    def submit(self, command: Callable[[], T]) -> T:
        """Run a command in the relay's thread, from another thread, and return its result.

        Raises:
            PeerError: the relay has ended, or does not answer.
        """
        future: Future[T] = Future()
        with self._lock:
            if self._closed:
                raise PeerError("the emulator has ended")
            self._waiting.put((future, command))
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
        return self.submit(self.look)

    def look(self) -> Snapshot:
        """Return the state of the relay, in its thread or after its end."""
        return Snapshot(
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

        def command() -> None:
            for direction in directions:
                self._relay.change(link, direction, settings)
            (report,) = (one for one in self._relay.report() if one.name == link)
            for direction in directions:
                counters = replace(getattr(report, direction).counters)
                self._in_force[link, direction] = AppliedSettings(settings, counters)

        self.submit(command)


_PUBLISH_S = 1.0
_QUERIES = 64
"""Maximum number of waiting queries of each kind; a new query replaces the oldest."""


class SettingsChange(BaseModel):
    """The content of a ``change`` query."""

    model_config = ConfigDict(extra="forbid", strict=True)

    link: str | None = None
    direction: Literal["forward", "reverse", "both"] = "forward"
    words: str | list[str] | None = None
    settings: LinkSettings | None = None

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.words is None) == (self.settings is None):
            raise ValueError("give words, or settings")
        return self


class ControlServer:
    """Answers queries about a relay, and changes it, within the context.

    Args:
        name: the emulator's name.
        commands: gives access to the relay.

    Raises:
        CallerError: the name is not allowed, or in use.
        MachineError: the socket cannot be listened on.
    """

    def __init__(self, name: str, commands: CommandQueue) -> None:
        self._name = name
        self._commands = commands
        self._thread = StatisticsThread(commands, _PUBLISH_S, self._publish, poll=self._serve)
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(published(self._name))
            self._session = self._open()
            stack.callback(self._session.close)
            self._queryables = [
                (self._session.declare_queryable(self._key(what), RingChannel(_QUERIES)), answer)
                for what, answer in (
                    ("report", self._report),
                    ("settings", self._settings),
                    ("change", self._change),
                )
            ]
            stack.enter_context(self._thread)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _open(self) -> zenoh.Session:
        try:
            return open_session(EMULATORS, self._name, listen=True)
        except zenoh.ZError as error:
            raise MachineError(f"live control cannot be started: {cause_of(error)}") from None

    def _key(self, what: str) -> str:
        return f"netem/{self._name}/{what}"

    def _serve(self) -> None:
        for queryable, answer in self._queryables:
            while (query := queryable.try_recv()) is not None:
                self._reply(query, answer)

    def _publish(self, document: Statistics) -> None:
        self._session.put(
            self._key("statistics"),
            json.dumps(document),
            congestion_control=CongestionControl.DROP,
            priority=Priority.BACKGROUND,
        )

    def _reply(self, query: zenoh.Query, answer: Callable[[dict[str, Any]], object]) -> None:
        try:
            content = json.dumps(answer(_content(query)))
            query.reply(query.key_expr, content)
        except NoackError as error:
            query.reply_err(str(error))
        except Exception as error:
            traceback.print_exc()
            query.reply_err(f"internal error of the emulator: {error!r}")
        finally:
            query.drop()  # type: ignore[no-untyped-call]

    def _report(self, _: Mapping[str, Any]) -> object:
        return self._thread.now()

    def _settings(self, _: Mapping[str, Any]) -> object:
        links = [
            {"name": link.name}
            | {name: _settings(getattr(link, name).settings) for name in DIRECTIONS}
            for link in self._commands.snapshot().links
        ]
        return {"links": links}

    def _change(self, content: Mapping[str, Any]) -> object:
        try:
            change = SettingsChange.model_validate_json(json.dumps(content))
        except ValidationError as error:
            raise CallerError(brief(error)) from None
        settings = change.settings
        if settings is None:
            settings = settings_of(change.words or [])
        _require_read(settings)
        try:
            with_kept_loss(settings)
        except ValueError as error:
            raise CallerError(str(error)) from None
        directions: Sequence[Direction] = (
            DIRECTIONS if change.direction == "both" else (change.direction,)
        )
        self._commands.change(self._link(change.link), directions, settings)
        return self._settings({})

    def _link(self, name: str | None) -> str:
        names = self._commands.links
        if name is None and len(names) == 1:
            return names[0]
        if name is None:
            raise CallerError(f"which link? Links: {', '.join(names)}")
        if name not in names:
            raise CallerError(f"no link {name!r}; links: {', '.join(names)}")
        return name


def _settings(settings: LinkSettings) -> object:
    return {"words": text_of(settings), "settings": settings.model_dump(mode="json")}


def _require_read(settings: LinkSettings) -> None:
    for impairment in settings.impairments:
        file = getattr(getattr(impairment, "loss", impairment), "file", None)
        if file is not None:
            raise CallerError(f"{file}: read the file first, and send its content as settings")


def _content(query: zenoh.Query) -> dict[str, Any]:
    """Return the content of a query; raise CallerError unless it is a JSON object."""
    try:
        content = json.loads(query.payload.to_string() if query.payload else "{}")
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise CallerError("a query is a JSON object")
    return content
