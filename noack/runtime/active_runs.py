"""The active runs of the user, and changes of their settings.

The launcher keeps a lock file for its run beside the socket of the run's control plane. By these
files other programs of the user find the active runs.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import zenoh
from pydantic import ConfigDict, TypeAdapter, ValidationError

from netem.core.errors import CallerError, PeerError
from netem.core.private_folder import LockFile, live_lock_files, lock_file
from netem.core.toml_file import brief
from noack.runtime.connections.zenoh_session import answer_to, cause_of, open_session
from noack.runtime.control_messages import ChangeReply, ChangeRequest, message_json, parse_message
from noack.runtime.run_descriptor import RunAccess
from noack.scenario.runtime_parameters import require_finite

RUNS = "runs"
"""Folder of the active runs in the user's runtime directory: sockets, lock files."""
_ANSWER_S = 30.0
"""Longest wait for the answer to a change of settings."""


def run_name(run_id: int) -> str:
    """Return a run's name in that folder and in the keys of its control plane."""
    return f"{run_id:016x}"


class OpenRun(NamedTuple):
    """The names by which a run is reached."""

    name: str  # of its socket, and in the keys of its control plane
    run_dir: str
    session: str | None  # session name for processes started by hand; None if all were launched


_OPEN_RUN = TypeAdapter(OpenRun, config=ConfigDict(defer_build=True))


@contextmanager
def registered_run(access: RunAccess, session: str | None) -> Iterator[Path]:
    """Keep a run's lock file while the context lasts."""
    run = OpenRun(run_name(access.run_id), access.run_dir, session)
    with lock_file(RUNS, run.name, run._asdict()) as path:
        yield path


def active_runs() -> list[OpenRun]:
    """Return the user's active runs. Raise PeerError if the file of one is not valid."""
    return [_open_run(file) for file in live_lock_files(RUNS)]


def find_run(session: str | None = None, run_dir: Path | None = None) -> OpenRun:
    """Return the user's active run, of this session or with this run directory.

    Raise CallerError if no such run is active, or several are.
    """
    runs = active_runs()
    matching = [
        run
        for run in runs
        if (session is None or run.session == session)
        and (run_dir is None or Path(run.run_dir) == run_dir.resolve())
    ]
    if len(matching) == 1:
        return matching[0]
    if not runs:
        ended = "" if run_dir is None else f"the run {run_dir} is not active, and "
        raise CallerError(f"{ended}no run is active; start one, e.g. `noack demo`")
    active = "active: " + ", ".join(run.run_dir for run in matching or runs)
    if matching:
        raise CallerError(f"several runs are {active}; choose one by --run DIRECTORY")
    criterion = f"in session {session!r}" if run_dir is None else f"in {run_dir}"
    raise CallerError(f"no run is active {criterion}; {active}")


def request_change(run: OpenRun, settings: Mapping[str, object]) -> ChangeReply:
    """Request a change of runtime parameters; without settings, their values. Return the answer.

    Raise CallerError, with one line per mistake, for wrong settings, PeerError without an answer.
    """
    require_finite(settings)
    request = message_json(ChangeRequest.model_validate({"settings": dict(settings)}))
    try:
        with open_session(RUNS, run.name, listen=False) as plane:
            answer = answer_to(plane, f"noack/{run.name}/runtime_parameters", request, _ANSWER_S)
    except zenoh.ZError as error:
        raise PeerError(f"{run.run_dir}: the run cannot be reached: {cause_of(error)}") from None
    if answer is None:
        raise PeerError(f"{run.run_dir}: the run does not answer")
    return parse_message(ChangeReply, answer)


def _open_run(file: LockFile) -> OpenRun:
    try:
        return _OPEN_RUN.validate_json(file.content, strict=True)
    except ValidationError as error:
        raise PeerError(f"{file.path}: not a valid file of an active run: {brief(error)}") from None
