"""Live control of a running emulator: its servers, its name, and its token.

It listens on a Unix socket beside its file (:mod:`netem.control.running_emulators`), and if asked to
also on a loopback port, for requests with a token. Requests are answered in threads of their own, which
reach the relay between two batches of datagrams.
"""

import os
import re
import secrets
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from netem.control.command_queue import CommandQueue
from netem.control.control_routes import ControlRoutes
from netem.control.emulator_statistics import StatisticsThread
from netem.control.http_server import LOOPBACK, TcpHttpServer, UnixHttpServer, serving
from netem.control.running_emulators import emulator_folder, registered_emulator, socket_path
from netem.core.errors import CallerError, MachineError, why
from netem.core.file_access import read_regular
from netem.core.private_folder import PrivateFolder

TOKEN_VARIABLE = "NOACK_NETEM_TOKEN"
"""Environment variable with the token, if no file is given."""
_TOKEN = re.compile(r"[!-~]{16,256}")
_RECENT_S = 1.0
"""Time between two snapshots, from which recent rates are computed."""


class TcpAccess(NamedTuple):
    """A loopback port on which requests with a token are accepted."""

    port: int
    """0 takes a free one."""
    token_file: Path | None = None
    """The file with the token; None: see :func:`read_token`."""


class ControlAddresses(NamedTuple):
    """Where a running emulator accepts requests."""

    socket: Path
    url: str | None
    """Of the loopback port."""
    token_file: Path | None
    """The file with the token that was made for this port; None if there was one already."""

    def document(self) -> Mapping[str, str | None]:
        """Return the addresses for other programs."""
        return {
            "socket": str(self.socket),
            "url": self.url,
            "token_file": None if self.token_file is None else str(self.token_file),
        }

    def lines(self) -> Iterator[str]:
        """Yield the addresses for people."""
        yield f"control: curl --unix-socket {self.socket} http://localhost/links"
        if self.url is not None:
            token = "as given" if self.token_file is None else f"in {self.token_file}"
            yield f"control: {self.url}, token {token}"


def read_token(file: Path | None) -> str | None:
    """Return the token of a file, or without one of the environment; None if there is none.

    Raises:
        CallerError: the file cannot be read, or the token is too short or has other characters.
    """
    if file is None:
        source, token = f"${TOKEN_VARIABLE}", os.environ.get(TOKEN_VARIABLE)
        if token is None:
            return None
    else:
        source = f"--control-token {file}"
        try:
            token = read_regular(file, 2**20).decode("ascii", "replace").strip()
        except (OSError, ValueError) as error:
            raise CallerError(f"{source}: cannot be read: {why(error)}") from None
    if not _TOKEN.fullmatch(token):
        raise CallerError(f"{source}: a token has 16 to 256 letters, digits and signs, without spaces")
    return token


@contextmanager
def control_server(
    name: str, commands: CommandQueue, tcp: TcpAccess | None = None
) -> Iterator[ControlAddresses]:
    """Answer requests about a relay, and change it, within the context; yields where.

    Args:
        name: the emulator's name.
        commands: give access to the relay.
        tcp: also listen on a loopback port.

    Raises:
        CallerError: the name is not allowed, or in use; so is the port; or the token is wrong.
        MachineError: the socket cannot be listened on.
    """
    token = None if tcp is None else read_token(tcp.token_file)
    with ExitStack() as stack:
        folder = stack.enter_context(emulator_folder(create=True))
        stack.enter_context(registered_emulator(name))
        statistics = stack.enter_context(StatisticsThread(commands, _RECENT_S))
        routes = ControlRoutes(commands, statistics.current)
        url = token_file = None
        if tcp is not None:
            made = token is None
            token = token or secrets.token_urlsafe(32)
            server = TcpHttpServer(tcp.port, token, routes)
            _enter(stack, server, lambda error: CallerError(_port_problem(tcp.port, error)))
            url = f"http://{LOOPBACK}:{server.server_port}"
            token_file = _write_token(folder, name, token) if made else None
        with suppress(FileNotFoundError):  # of an emulator that ended without removing it
            folder.remove(f"{name}.sock")
        unix = UnixHttpServer(socket_path(folder, name), routes)
        _enter(stack, unix, lambda error: MachineError(f"live control cannot be started: {why(error)}"))
        yield ControlAddresses(folder.path / f"{name}.sock", url, token_file)


def _enter(
    stack: ExitStack, server: TcpHttpServer | UnixHttpServer, error_of: Callable[[OSError], Exception]
) -> None:
    try:
        stack.enter_context(serving(server))
    except OSError as error:
        raise error_of(error) from None


def _port_problem(port: int, error: OSError) -> str:
    return f"--control-port {port}: {why(error)}; choose another port, or 0 for a free one"


def _write_token(folder: PrivateFolder, name: str, token: str) -> Path:
    file_name = f"{name}.token"
    try:
        with os.fdopen(folder.create(file_name), "w") as file:
            file.write(token + "\n")
    except OSError as error:
        raise MachineError(f"{folder.path / file_name}: cannot be written: {why(error)}") from None
    return folder.path / file_name
