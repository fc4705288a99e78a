"""Live control of a running emulator by zenoh: its queries.

It listens on a Unix socket beside its file (:mod:`netem.control.running_emulators`). Below
``netem/NAME`` it answers ``report``, ``settings`` and ``change``, and publishes ``statistics`` once a
second, as docs/netem-control.md describes, in a thread of its own. A query with a mistake is answered
with one line, and changes nothing.
"""

import json
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from typing import Literal, Self

import zenoh
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from zenoh import CongestionControl, Priority
from zenoh.handlers import RingChannel

from netem.control.command_queue import CommandQueue
from netem.control.emulator_statistics import Statistics, StatisticsThread
from netem.control.running_emulators import EMULATORS, registered_emulator
from netem.control.zenoh_session import cause_of, open_session
from netem.core.errors import CallerError, MachineError, NoackError
from netem.core.json_text import parse_json
from netem.core.toml_file import brief
from netem.impairments.link_settings import LinkSettings
from netem.impairments.target_loss import with_target_loss
from netem.relay.relay_reports import DIRECTIONS, Direction
from netem.tc_words import settings_of, words_of

_PUBLISH_S = 1.0
"""Time between two published statistics."""
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
            stack.enter_context(registered_emulator(self._name))
            try:
                self._session = open_session(EMULATORS, self._name, listen=True)
            except zenoh.ZError as error:
                raise MachineError(f"live control cannot be started: {cause_of(error)}") from None
            stack.callback(self._session.close)
            self._queryables = [
                (self._session.declare_queryable(self._key(query), RingChannel(_QUERIES)), answer)
                for query, answer in (
                    ("report", lambda _: self._thread.current()),
                    ("settings", self._settings),
                    ("change", self._change),
                )
            ]
            stack.enter_context(self._thread)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def _key(self, query: str) -> str:
        return f"netem/{self._name}/{query}"

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

    def _reply(self, query: zenoh.Query, answer: Callable[[dict[str, object]], object]) -> None:
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

    def _settings(self, _: Mapping[str, object]) -> object:
        links = [
            {"name": link.name}
            | {name: _settings_document(getattr(link, name).settings) for name in DIRECTIONS}
            for link in self._commands.snapshot().links
        ]
        return {"links": links}

    def _change(self, content: Mapping[str, object]) -> object:
        try:
            change = SettingsChange.model_validate_json(json.dumps(content))
        except ValidationError as error:
            raise CallerError(brief(error)) from None
        settings = change.settings
        if settings is None:
            settings = settings_of(change.words or [])
        _require_read(settings)
        try:
            with_target_loss(settings)
        except ValueError as error:
            raise CallerError(str(error)) from None
        directions: Sequence[Direction] = DIRECTIONS if change.direction == "both" else (change.direction,)
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


def _settings_document(settings: LinkSettings) -> object:
    return {"words": words_of(settings), "settings": settings.model_dump(mode="json")}


def _require_read(settings: LinkSettings) -> None:
    for impairment in settings.impairments:
        file = getattr(getattr(impairment, "loss", impairment), "file", None)
        if file is not None:
            raise CallerError(f"{file}: read the file first, and send its content as settings")


def _content(query: zenoh.Query) -> dict[str, object]:
    """Return the content of a query; raise CallerError unless it is a JSON object."""
    try:
        content = parse_json(query.payload.to_string() if query.payload else "{}")
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise CallerError("a query is a JSON object")
    return content
