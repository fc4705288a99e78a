"""What the routes of live control answer: links, changes, statistics, metrics.

They are functions of a request's method, target and body. :mod:`netem.control.http_server` brings
requests to them; docs/netem-control.md has the documents.
"""

import traceback
from collections.abc import Callable, Mapping
from http import HTTPStatus
from threading import Lock
from typing import ClassVar, NamedTuple
from urllib.parse import unquote, urlsplit

from pydantic import ValidationError, model_validator
from pydantic_core import to_json

from netem.control.command_queue import AppliedSettings, CommandQueue, Snapshot
from netem.control.emulator_statistics import Statistics
from netem.control.metrics_text import METRICS_TYPE, metrics_text
from netem.core import toml_file
from netem.core.address import address_text
from netem.core.command_line import netem_program
from netem.core.errors import CallerError, NoackError, printable, shortened, with_short_words
from netem.core.json_text import parse_json
from netem.core.settings_section import ScenarioSection
from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from netem.links_file import Side
from netem.relay.relay_reports import DIRECTIONS, Direction, LinkReport

JSON_TYPE = "application/json"
_PATHS = "/links, /links/NAME, /stats, /metrics"
_EXAMPLE = '{"forward": "loss 5% mansd 4"}'


class Answer(NamedTuple):
    """The answer to a request."""

    status: HTTPStatus
    content: str
    content_type: str = JSON_TYPE
    headers: tuple[tuple[str, str], ...] = ()


class LinkChange(ScenarioSection):
    """The body of ``PATCH /links/NAME``: the settings of the directions that change."""

    key_hints: ClassVar[Mapping[str, str]] = {
        "words": f"give the words themselves, e.g. {_EXAMPLE}",
        "settings": "give the table itself, without `settings` around it",
    }

    forward: Side | None = None
    """From clients to the server: words, e.g. "delay 10ms loss 5%", or a table."""
    reverse: Side | None = None
    """From the server to the clients: words or a table, as for forward."""

    @model_validator(mode="after")
    def _check(self) -> "LinkChange":
        if self.forward is None and self.reverse is None:
            raise ValueError(f"give forward, reverse or both, e.g. {_EXAMPLE}")
        return self

    @property
    def directions(self) -> Mapping[Direction, LinkSettings]:
        """The settings by direction."""
        return {name: settings for name in DIRECTIONS if (settings := getattr(self, name)) is not None}


def error_answer(status: HTTPStatus, message: str, *headers: tuple[str, str]) -> Answer:
    """Return an answer with a line of JSON, ``{"error": message}``."""
    return _json_answer({"error": with_short_words(message)}, status, headers)


def _json_answer(
    document: object, status: HTTPStatus = HTTPStatus.OK, headers: tuple[tuple[str, str], ...] = ()
) -> Answer:
    # json.dumps would keep other threads, also the relay's, from running: 0.4 s for a large table.
    return Answer(status, to_json(document).decode() + "\n", headers=headers)


class _RefusedError(Exception):
    """A request that has another answer than its route's."""

    def __init__(self, status: HTTPStatus, message: str, *headers: tuple[str, str]) -> None:
        super().__init__(message)
        self.answer = error_answer(status, message, *headers)


class ControlRoutes:
    """The routes of an emulator's control.

    Args:
        commands: give access to the relay.
        current: returns the relay's present statistics.
    """

    def __init__(self, commands: CommandQueue, current: Callable[[], Statistics]) -> None:
        self._commands = commands
        self._current = current
        self._turn = Lock()
        """For answers that may be large: many at a time would leave the relay's thread no turn."""

    def answer(self, method: str, target: str, body: bytes) -> Answer:
        """Return the answer to a request; a request with a mistake changes nothing."""
        try:
            return self._route(method, target)(body)
        except _RefusedError as refused:
            return refused.answer
        except CallerError as error:
            return error_answer(HTTPStatus.BAD_REQUEST, str(error))
        except NoackError as error:  # the emulator ends, or is stopped
            return error_answer(HTTPStatus.SERVICE_UNAVAILABLE, str(error))
        except Exception as error:
            traceback.print_exc()
            return error_answer(
                HTTPStatus.INTERNAL_SERVER_ERROR, printable(f"internal error of the emulator: {error!r}")
            )

    def _route(self, method: str, target: str) -> Callable[[bytes], Answer]:
        try:
            url = urlsplit(target)
        except ValueError:
            raise _RefusedError(
                HTTPStatus.BAD_REQUEST, f"{_quoted(target)}: not a path; there are {_PATHS}"
            ) from None
        if url.query:
            raise _RefusedError(
                HTTPStatus.BAD_REQUEST, f"?{_quoted(url.query)}: there are no parameters; leave them out"
            )
        routes: Mapping[str, Callable[[bytes], Answer]]
        match url.path.split("/")[1:]:
            case ["links"]:
                routes = {"GET": self._links}
            case ["links", encoded] if encoded:
                name = unquote(encoded)
                routes = {
                    "GET": lambda _: self._link(name),
                    "PATCH": lambda body: self._change(name, body),
                }
            case ["stats"]:
                routes = {"GET": lambda _: _json_answer(self._current())}
            case ["metrics"]:
                routes = {"GET": self._metrics}
            case _:
                raise _RefusedError(
                    HTTPStatus.NOT_FOUND, f"{_quoted(url.path)}: no such path; there are {_PATHS}"
                )
        if method not in routes:
            raise _RefusedError(
                HTTPStatus.METHOD_NOT_ALLOWED,
                f"{_quoted(method)} {_quoted(url.path)}: expected {' or '.join(routes)}",
                ("Allow", ", ".join(routes)),
            )
        return routes[method]

    def _links(self, _: bytes) -> Answer:
        snapshot = self._commands.snapshot()
        with self._turn:
            return _json_answer({"links": [_link_document(link, snapshot) for link in snapshot.links]})

    def _link(self, name: str) -> Answer:
        snapshot = self._commands.snapshot()
        for link in snapshot.links:
            if link.name == name:
                with self._turn:
                    return _json_answer(_link_document(link, snapshot))
        raise self._no_link(name)

    def _no_link(self, name: str) -> _RefusedError:
        links = ", ".join(self._commands.links)
        return _RefusedError(HTTPStatus.NOT_FOUND, f"no link {shortened(name)!r}; links: {links}")

    def _change(self, name: str, body: bytes) -> Answer:
        if name not in self._commands.links:
            raise self._no_link(name)
        source = f"PATCH /links/{name}"
        changes = _read_change(body, source).directions
        for direction, settings in changes.items():
            _require_read(settings, f"{source}: {direction}")
            try:
                LinkState(settings, 0)  # the relay accepts it
            except ValueError as error:
                raise CallerError(f"{source}: {direction}: {error}") from None
        self._commands.change(name, changes)
        return self._link(name)

    def _metrics(self, _: bytes) -> Answer:
        return Answer(HTTPStatus.OK, metrics_text(self._current()), METRICS_TYPE)


def _quoted(text: str) -> str:
    return printable(shortened(text))


def _read_change(body: bytes, source: str) -> LinkChange:
    """Return the content of a request to change a link; raise CallerError if it is wrong."""
    try:
        content = parse_json(body)
    except ValueError as error:  # also of bytes that are no text
        why = f"not JSON ({error})" if body else "empty"
        raise CallerError(printable(f"{source}: the body is {why}; expected e.g. {_EXAMPLE}")) from None
    if not isinstance(content, dict):
        raise CallerError(f"{source}: the body is no JSON object; expected e.g. {_EXAMPLE}")
    for name in content.keys() & {*DIRECTIONS}:
        value = content[name]
        if value is not None and not isinstance(value, str | dict):
            raise CallerError(
                f"{source}: {name} = {toml_file.show_value(value)}: expected words, "
                'e.g. "loss 5% mansd 4", or a table of settings'
            )
    toml_file.require_levels(content, source)
    try:
        return LinkChange.model_validate_json(body)
    except ValidationError as error:
        raise CallerError("\n".join(toml_file.explain(error, source, LinkChange))) from None


def _link_document(link: LinkReport, snapshot: Snapshot) -> object:
    addresses = {"name": link.name, "listen": address_text(link.listen), "to": address_text(link.to)}
    return addresses | {name: _settings_document(snapshot.applied[link.name, name]) for name in DIRECTIONS}


def _settings_document(applied: AppliedSettings) -> object:
    return {"words": applied.words, "settings": applied.settings.model_dump(mode="json")}


def _require_read(settings: LinkSettings, source: str) -> None:
    for impairment in settings.impairments:
        file = getattr(getattr(impairment, "loss", impairment), "file", None)
        if file is not None:
            raise CallerError(
                f"{source}: {file}: files are not read here; send the content as a table, "
                f"or use `{netem_program()} set`"
            )
