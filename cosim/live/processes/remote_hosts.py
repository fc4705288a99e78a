"""The other hosts of a run, and how its processes are started there.

``ssh`` asks for nothing: a key, or an agent, must be set up, and the host's key known. The invitation
goes through ssh to the process's standard input, and is in no file.
"""

import shlex
import shutil
import subprocess
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Annotated, NamedTuple, Self

from pydantic import AfterValidator, Field, model_validator

from noack.core.errors import CallerError
from noack.protocol.roles import LOOP_ROLES
from noack.scenario import toml_file
from noack.settings.section import ScenarioSection

SSH_FAILED = 255
"""Exit status of ssh when its connection cannot be made, or breaks."""
_CONNECT_WITHIN_S = 10
_OPTIONS = ("-T", "-o", "BatchMode=yes", "-o", f"ConnectTimeout={_CONNECT_WITHIN_S}")


def _require_printable(text: str) -> str:
    if not text.isprintable():  # no argument of a command has a zero character
        raise ValueError("has a control character")
    return text


_Word = Annotated[str, Field(min_length=1), AfterValidator(_require_printable)]


class Host(ScenarioSection):
    """Where a process runs."""

    ssh: Annotated[_Word, Field(pattern=r"^[^-\s]\S*$")]
    """The host, as the command ssh takes it: a name of ~/.ssh/config, HOST or USER@HOST."""
    command: _Word = "noack"
    """How noack is called there, e.g. "noack/.venv/bin/noack"; the shell of that host reads it."""
    runs: _Word = "runs"
    """Folder there for rows that cannot be sent to the recorder."""


class Hosts(ScenarioSection):
    """The hosts of a run: processes without a table run on the host of the recorder."""

    listen: str
    """Address of this host at which the others reach it: ADDRESS or ADDRESS:PORT."""
    plant: Host | None = None
    """Where the plant runs."""
    sensor: Host | None = None
    """Where the sensor runs."""
    netem: Host | None = None
    """Where the network emulator runs."""
    controller: Host | None = None
    """Where the controller runs."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if not self.by_role:
            raise ValueError(f"no process is on another host; name one of {', '.join(LOOP_ROLES)}")
        return self

    @property
    def by_role(self) -> Mapping[str, Host]:
        """The hosts of the processes that do not run here."""
        given = {role: getattr(self, role) for role in LOOP_ROLES}
        return {role: host for role, host in given.items() if host is not None}


def load_hosts(path: Path) -> Hosts:
    """Read a file of hosts; raise CallerError if it is wrong, or no ssh client is installed."""
    hosts = toml_file.validated(Hosts, toml_file.read(path, Hosts), str(path))
    if shutil.which("ssh") is None:
        raise CallerError("--hosts: no ssh client is installed; install openssh-client")
    return hosts


class RemoteStart(NamedTuple):
    """What is needed to start the processes on other hosts."""

    hosts: Mapping[str, Host]
    invitation: str
    """The content of the invitation."""


def start_over_ssh(role: str, host: Host, invitation: str, log: IO[str]) -> subprocess.Popen[str]:
    """Start a process on another host, which ends by itself, with the run.

    Raise OSError if ssh cannot be started.
    """
    remote = f"{host.command} {role} --invitation - --runs {shlex.quote(host.runs)}"
    child = subprocess.Popen(
        ["ssh", *_OPTIONS, "--", host.ssh, remote],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        encoding="utf-8",
        start_new_session=True,  # the launcher handles Ctrl-C
    )
    assert child.stdin is not None
    with suppress(BrokenPipeError), child.stdin:
        child.stdin.write(invitation)
    return child
