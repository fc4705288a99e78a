"""Live control of a running emulator: its file, by which commands find it, and its queries.

While an emulator runs, its file is in the user's runtime directory
(:mod:`noack.runtime.private_folder`), beside the Unix socket on which it listens, which only its
user can reach. Below ``netem/NAME`` it answers ``report``, ``settings`` and ``change``, and
publishes ``statistics`` once a second, as docs/netem-control.md describes, in a thread of its own.
A query with a mistake is answered with one line, and changes nothing.
"""

import json
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Literal, Self

import zenoh
from pydantic import BaseModel, ConfigDict, ValidationError, model_validator
from zenoh import CongestionControl, Priority
from zenoh.handlers import RingChannel

from netem.control.command_queue import CommandQueue
from netem.control.emulator_statistics import Statistics, StatisticsThread
from netem.relay.relay_reports import DIRECTIONS, Direction
from netem.tc_words import settings_of, words_of
from noack.core.errors import CallerError, MachineError, NoackError, PeerError
from noack.core.json_text import parse_json
from noack.impairments.link_settings import LinkSettings
from noack.impairments.target_loss import with_target_loss
from noack.runtime import private_folder
from noack.runtime.connections.zenoh_session import cause_of, open_session
from noack.runtime.private_folder import require_name
from noack.scenario.toml_file import brief

EMULATORS = "netem"
"""The folder of the files."""
_STARTING = "netem_starting"
"""The folder of the files of emulators that start."""


def _in_use(name: str) -> CallerError:
    return CallerError(f"--control {name}: an emulator of this name runs; choose another name")


@contextmanager
def registered_emulator(name: str, folder: str = EMULATORS) -> Iterator[Path]:
    """Keep an emulator's file within the context.

    Raises:
        CallerError: the name is not allowed or in use, or the folder is not the user's own.
    """
    require_name(name, "emulator")
    with ExitStack() as stack:
        try:
            path = stack.enter_context(private_folder.lock_file(folder, name, {}))
        except FileExistsError:
            raise _in_use(name) from None
        yield path


@contextmanager
def starting(name: str | None) -> Iterator[None]:
    """Publish within the context that an emulator of this name, if any, starts.

    Raises:
        CallerError: the name is not allowed or in use, or the folder is not the user's own.
    """
    if name is None:
        yield
        return
    with registered_emulator(name, _STARTING):
        if name in running_emulators():
            raise _in_use(name)
        yield


def running_emulators() -> list[str]:
    """Return the names of this user's emulators that accept commands.

    Raises:
        CallerError: other users have access to the folder.
    """
    return list(_files())


def find_emulator(name: str | None) -> str:
    """Return the name of a running emulator; if ``name`` is None, of the only one.

    Raises:
        CallerError: there is no such emulator, or several run and none is named.
        PeerError: it is still starting.
    """
    files = _files()
    starting_names = [file.path.stem for file in private_folder.live_lock_files(_STARTING)]
    if name not in files and (name in starting_names or (name is None and starting_names and not files)):
        raise PeerError(
            f"emulator {name or starting_names[0]!r} is starting; "
            "it prints `ready` on standard output when it accepts commands"
        )
    if not files:
        name_text = "" if name is None else f" {name!r}"
        raise CallerError(
            f"no emulator{name_text} accepts commands; start one with `noack netem --control NAME …`"
        )
    if name is None and len(files) > 1:
        raise CallerError(f"which emulator? Running: {', '.join(files)}")
    name = name or next(iter(files))
    if name not in files:
        raise CallerError(f"no emulator {name!r}; running: {', '.join(files)}")
    return name


def _files() -> dict[str, private_folder.LockFile]:
    return {file.path.stem: file for file in private_folder.live_lock_files(EMULATORS)}


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
