"""Requests to a running emulator, by HTTP over its Unix socket."""

import json
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from http.client import HTTPConnection, HTTPException
from typing import Any, cast
from urllib.parse import quote

from netem.control.emulator_statistics import Statistics
from netem.control.running_emulators import emulator_folder, socket_path
from netem.core.errors import CallerError, PeerError

_ANSWER_S = 30.0
"""Longest wait for an answer."""
_POLL_S = 0.02


class _UnixConnection(HTTPConnection):
    """A connection to a Unix socket."""

    def __init__(self, path: str) -> None:
        super().__init__("localhost", timeout=_ANSWER_S)
        self._path = path

    def connect(self) -> None:
        self.sock = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self.sock.settimeout(self.timeout)
        self.sock.connect(self._path)


class Client:
    """Requests to the running emulator of this name; see docs/netem-control.md for the documents.

    Each method raises CallerError if the request has a mistake, PeerError if the emulator has ended or
    does not answer.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def links(self) -> list[dict[str, Any]]:
        """Return the links with their settings."""
        return list(self._ask("GET", "/links")["links"])

    def change(self, link: str, **directions: str | Mapping[str, object]) -> dict[str, Any]:
        """Change a link, and return it.

        Args:
            link: its name.
            directions: ``forward``, ``reverse`` or both: the settings, as words or as a table.
        """
        return dict(self._ask("PATCH", f"/links/{quote(link, safe='')}", directions))

    def statistics(self) -> Statistics:
        """Return the present statistics."""
        return cast(Statistics, self._ask("GET", "/stats"))

    def follow(self, period_s: float = 1.0, stop: Callable[[], bool] = lambda: False) -> Iterator[Statistics]:
        """Yield the statistics at once, and then every ``period_s``, until ``stop()``."""
        due_s = time.monotonic()
        while not stop():
            if (wait_s := due_s - time.monotonic()) > 0:
                time.sleep(min(wait_s, _POLL_S))
                continue
            due_s = time.monotonic() + period_s
            yield self.statistics()

    def _ask(self, method: str, path: str, content: object = None) -> Any:
        body = None if content is None else json.dumps(content, separators=(",", ":"))
        try:
            status, text = self._request(method, path, body)
        except (FileNotFoundError, ConnectionError, HTTPException):
            raise PeerError(f"emulator {self._name!r} has ended") from None
        except TimeoutError:
            raise PeerError(f"emulator {self._name!r} does not answer") from None
        except OSError as error:
            raise PeerError(f"emulator {self._name!r} cannot be reached: {error}") from None
        answer = json.loads(text)
        if status < 400:
            return answer
        raise (CallerError if status < 500 else PeerError)(answer["error"])

    def _request(self, method: str, path: str, body: str | None) -> tuple[int, bytes]:
        with emulator_folder() as folder:
            connection = _UnixConnection(socket_path(folder, self._name))
            try:
                connection.request(method, path, body)
                response = connection.getresponse()
                return response.status, response.read()
            finally:
                connection.close()
