"""The run directory: its files, the search for the newest one, how and where a run took place.

:class:`EndingFile` stores how the run ended as soon as it ends. The file is created blank when the
run begins. This reserves its space on the disk, so the reason can be stored even if the disk is
full or no longer writable. :func:`write_environment` stores versions, computer and command.
"""

import contextlib
import json
import os
import platform
import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from netem.core.errors import CallerError, ExitStatus, MachineError, NoackError, why
from netem.core.file_access import create_folder, locked, open_growing, read_regular, write_link, write_whole
from netem.core.json_text import parse_json
from netem.core.system_processes import cores
from noack.runtime.spool import SPOOL

DEFAULT_RUNS = Path("runs")
"""Folder for run directories, relative to the current folder."""
SCENARIO_FILE = "scenario.toml"
ENVIRONMENT_FILE = "environment.json"
REPORTS_FILE = "reports.json"
RECORDING_FILE = "recording.rrd"
PROCESSES_FILE = "processes.json"
"""The roles of the processes of a live run, by instance."""
ENDING_FILE = "ending.json"
SUMMARY_FILE = "summary.json"
REPORT_FILE = "report.html"
RECORD = "record"
LATEST = "latest"
CAMPAIGN_FILE, CAMPAIGN_PAGE = "campaign.json", "campaign.html"
_KEPT = frozenset({
    SCENARIO_FILE, ENVIRONMENT_FILE, REPORTS_FILE, RECORDING_FILE, PROCESSES_FILE, ENDING_FILE,
    SUMMARY_FILE, REPORT_FILE, CAMPAIGN_FILE, CAMPAIGN_PAGE,
})  # fmt: skip
"""Files of the folders of runs and campaigns, which no other output replaces."""
_RESULT_FOLDERS = {
    RECORD: ENVIRONMENT_FILE,
    SPOOL: ENVIRONMENT_FILE,
    "logs": ENVIRONMENT_FILE,
    "runs": CAMPAIGN_FILE,
}
"""Folders of results by name, in which no other output is written, each with a file beside it."""
_LOCK = ".lock"
_HAS_LINKS = hasattr(os, "geteuid")  # not on Windows
_MOST_JSON_BYTES = 256 * 2**20
LEAST_FREE_BYTES = 16 * 1024 * 1024


def new_run_dir(runs: Path, name: str) -> Path:
    """Create a fresh run directory below ``runs``.

    Raises:
        CallerError: the path is not UTF-8, or has another kind of results.
        MachineError: the directory cannot be created.
    """
    _require_utf8(runs)
    if (holder := holder_of(runs)) is not None:
        raise CallerError(f"{runs}: {holder}, not a folder of run directories; give another --runs")
    refuse_among_results(runs)
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    try:
        create_folder(runs)
        free_bytes = shutil.disk_usage(runs).free
        if free_bytes < LEAST_FREE_BYTES:
            raise MachineError(
                f"{runs}: only {free_bytes // 1024} KiB are free on the disk; a run needs "
                f"at least {LEAST_FREE_BYTES // 2**20} MiB"
            )
        for attempt in range(1000):
            run_dir = runs / (f"{stamp}-{name}" + (f"-{attempt}" if attempt else ""))
            with contextlib.suppress(FileExistsError):
                create_folder(run_dir, exist_ok=False)
                create_folder(run_dir / "logs", exist_ok=False)
                return run_dir
    except OSError as error:
        raise MachineError(f"{runs}: no run directory can be created: {why(error)}") from None
    raise MachineError(f"{runs}: too many runs named {stamp}-{name}")


def holder_of(folder: Path) -> str | None:
    """Return what a folder is that holds the results of a run or a campaign, in words; None: neither."""
    if (folder / CAMPAIGN_FILE).is_file():
        return "the folder of a campaign"
    if (folder / SCENARIO_FILE).is_file() and (folder / ENVIRONMENT_FILE).is_file():
        return "the directory of a run"
    return None


def write_output(path: Path, content: str | bytes) -> Path:
    """Write a file that a user named, or replace it; return its path.

    Raises:
        CallerError: as :func:`require_output`.
        MachineError: it cannot be written.
    """
    require_output(path)
    return write_whole(path, content)


def require_output(path: Path, *, is_folder: bool = False) -> None:
    """Raise CallerError if an output may not or cannot be written to a file or folder that a user named.

    Args:
        path: of the file or the folder. It may not replace, or be among, the results of a run or a campaign.
        is_folder: it is a folder.
    """
    if (holder := holder_of(path)) is not None:
        raise CallerError(f"{path}: {holder}; give another name")
    if path.name in _KEPT and (holder := holder_of(path.parent)) is not None:
        raise CallerError(f"{path}: is a file of {holder}; give another name")
    require_folder(path if is_folder else path.parent, path)
    if not is_folder and path.is_dir():
        raise CallerError(f"{path}: is a folder; give the name of a file")


def require_folder(folder: Path, output: Path | None = None) -> None:
    """Raise CallerError, which names ``output``, if nothing may be written in a folder.

    A folder that does not exist can be written in if it can be made. The folders of the results of a
    run or a campaign are refused.
    """
    refuse_among_results(output or folder)
    existing = next((path for path in (folder, *folder.parents) if path.exists()), folder)
    if not (existing.is_dir() and os.access(existing, os.W_OK | os.X_OK)):
        named = f"{output or folder}: " + (f"{existing} " if existing != (output or folder) else "")
        raise CallerError(named + ("may not be written to" if existing.is_dir() else "is not a folder"))


def refuse_among_results(path: Path) -> None:
    """Raise CallerError if a file or folder would be among the results of a run or a campaign."""
    for folder in (path, *path.parents[:2]):
        holder = holder_of(folder.parent)
        beside = _RESULT_FOLDERS.get(folder.name)
        if beside and holder and (folder.parent / beside).is_file():
            raise CallerError(f"{path}: lies in {holder}, among its results; give another name")


def _require_utf8(path: Path) -> None:
    """Refuse a path that pyarrow, rerun and JSON cannot represent."""
    try:
        os.fspath(path.absolute()).encode()
    except UnicodeEncodeError:
        raise CallerError(f"{path}: the name of a folder is not UTF-8; rename it") from None


def how_to_complete(run_dir: Path) -> str:
    """Return what to do about a run whose end was interrupted."""
    return f"the run's record is incomplete: `noack summary {run_dir}` completes it"


def read_object(path: Path) -> dict[str, Any]:
    """Return the object of a JSON file of a run; empty if the file is missing or damaged."""
    try:
        content = parse_json(read_regular(path, _MOST_JSON_BYTES))
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def point_to_latest(run_dir: Path) -> None:
    """Link ``latest``, beside the run directory, to it; warn if this fails."""
    if not _HAS_LINKS:
        return
    latest = run_dir.parent / LATEST
    try:  # the link is optional, so its failure does not end the run
        write_link(latest, run_dir.name)
    except OSError as error:
        print(
            f"noack: warning: {latest} cannot be replaced: {why(error)}; this run is in {run_dir}",
            file=sys.stderr,
        )


def latest_run(runs: Path) -> Path:
    """Return the newest run directory below ``runs``.

    Raises:
        CallerError: there is none, or the link or the directory belongs to another user: opening a
            run may execute the code of its plant.
    """
    if not _HAS_LINKS:  # the names begin with the time
        if run_dirs := sorted(path.parent for path in runs.glob(f"*/{SCENARIO_FILE}")):
            return run_dirs[-1]
        raise CallerError(f"{runs}: no run yet; `noack simulate SCENARIO` makes one")
    link = runs / LATEST
    if not link.is_symlink() or not link.is_dir():
        raise CallerError(f"{runs}: no run yet; `noack demo` makes one")
    run_dir = link.resolve()
    if {link.lstat().st_uid, run_dir.stat().st_uid} != {os.geteuid()}:
        raise CallerError(
            f"{link}: the link, or the run that it leads to, is another user's; "
            "name the run directory, or a folder of your own by --runs"
        )
    return run_dir


def chosen_run(run_dir: Path | None, runs: Path) -> Path:
    """Return the given run directory, or the newest below ``runs`` if none is given.

    Raises:
        CallerError: as :func:`latest_run`, which also resolves a given ``latest``; or the path is
            not UTF-8.
    """
    _require_utf8(run_dir or runs)
    if run_dir is None:
        run_dir = latest_run(runs)
    elif run_dir.name == LATEST and run_dir.is_symlink():
        run_dir = latest_run(run_dir.parent)
    return run_dir


def is_run_directory(path: Path) -> bool:
    """Whether a folder has a scenario and something of its run, however early this was cut short."""
    of_run = (ENVIRONMENT_FILE, ENDING_FILE, RECORD, SPOOL)
    return (path / SCENARIO_FILE).is_file() and any((path / name).exists() for name in of_run)


def require_run_directory(path: Path) -> None:
    """Raise CallerError, which says what the path is instead, if it is no run directory."""
    if is_run_directory(path):
        return
    if not path.exists():
        raise CallerError(f"{path}: no such run directory")
    if path.is_dir():
        lacks = "only a scenario" if (path / SCENARIO_FILE).is_file() else f"no {SCENARIO_FILE}"
        raise CallerError(f"{path}: not a run directory ({holder_of(path) or lacks})")
    hint = ""
    for folder in path.parents:
        if not hint and (folder / SCENARIO_FILE).is_file() and (folder / RECORD).is_dir():
            hint = f"; did you mean {folder}?"
    if not hint and path.suffix == ".toml":
        hint = "; `noack simulate` and `noack run` make one from a scenario"
    raise CallerError(f"{path}: a file, not a run directory{hint}")


def file_of_loop(file: str, loop: str | None) -> str:
    """Return the name of a loop's own report or recording, such as ``report-NAME.html``."""
    base, dot, ending = file.rpartition(".")
    return file if loop is None else f"{base}-{loop}{dot}{ending}"


def loop_of_file(name: str, file: str) -> str | None:
    """Return the loop of a report or recording from its name; None for that of the run."""
    base, dot, ending = file.rpartition(".")
    inner = name.removeprefix(f"{base}-").removesuffix(f"{dot}{ending}")
    return inner if name == file_of_loop(file, inner) else None


def refuse_links(run_dir: Path) -> None:
    """Raise CallerError if a run directory, whose record is to be completed, has symbolic links.

    noack makes none there. In the directory of somebody else they might lead to files of the
    user's, which would be overwritten or removed.
    """
    for folder, folders, files in os.walk(run_dir):
        for name in (*folders, *files):
            if (path := Path(folder, name)).is_symlink():
                raise CallerError(f"{path}: is a symbolic link; a run directory has none")


@contextmanager
def active_run(run_dir: Path) -> Iterator[None]:
    """Mark a run as active, for its launcher and its recorder.

    Raises:
        MachineError: the directory cannot be written.
    """
    with _lock(run_dir, shared=True):
        yield


@contextmanager
def finished_run(run_dir: Path) -> Iterator[None]:
    """Lock the directory of a run that has ended.

    Raises:
        CallerError: the run is still active.
        MachineError: the directory cannot be written.
    """
    with _lock(run_dir) as alone:
        if not alone:
            raise CallerError(f"{run_dir}: the run is still under way")
        yield


@contextmanager
def _lock(run_dir: Path, *, shared: bool = False) -> Iterator[bool]:
    with ExitStack() as stack:
        try:
            alone = stack.enter_context(locked(run_dir / _LOCK, shared=shared, wait=shared))
        except OSError as error:
            raise MachineError(f"{run_dir}: the run cannot be written: {why(error)}") from None
        yield alone


_RESERVED_BYTES = 4096


@dataclass(frozen=True)
class RunEnding:
    """How a run ended."""

    run_dir: Path
    run_id: int
    status: ExitStatus
    reason: str
    startup_s: float | None = None
    """Wall time from the launch to simulated time 0; None if unknown."""


class EndingFile:
    """The file in which a run's launcher stores how the run ends.

    As a context manager it stores the error that leaves the context, unless an end is stored.

    Raises:
        MachineError: the file cannot be written.
    """

    def __init__(self, run_dir: Path) -> None:
        self._is_blank = True
        try:
            self._file = os.fdopen(open_growing(run_dir / ENDING_FILE), "wb", buffering=0)
            self._file.write(b" " * _RESERVED_BYTES)
        except OSError as error:
            raise MachineError(f"{run_dir}: the run cannot be written: {why(error)}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        _kind: type[BaseException] | None,
        error: BaseException | None,
        _traceback: TracebackType | None,
    ) -> None:
        if self._is_blank and isinstance(error, NoackError):
            self.store(error.exit_status, str(error))
        self._file.close()

    def store(self, status: ExitStatus, reason: str, startup_s: float | None = None) -> None:
        """Store how the run ended, under the keys of its summary."""
        self._is_blank = False
        content = {"exit": {"status": int(status), "reason": reason}, "startup_s": startup_s}
        text = json.dumps(content).encode().ljust(_RESERVED_BYTES)
        with contextlib.suppress(OSError):  # the terminal also shows the ending
            self._file.seek(0)
            self._file.write(text)
            self._file.truncate()


Kind = Literal["live", "simulated"]
"""Whether a run used processes (live) or virtual time (simulated)."""

_PACKAGES = ("noack", "numpy", "scipy", "eclipse-zenoh", "rerun-sdk", "pyarrow", "pydantic")
_ARITHMETIC = ("noack", "numpy", "scipy")


def environment(kind: Kind) -> dict[str, Any]:
    """Return the content of ``environment.json``."""
    return {
        "kind": kind,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in _PACKAGES},
        "system": platform.platform(),
        "machine": platform.machine(),
        "processor": _processor(),
        "cores": cores(),
    }


def write_environment(run_dir: Path, kind: Kind, run_name: str | None = None) -> None:
    """Write ``environment.json`` into a run directory; ``run_name`` is a live run's."""
    content = environment(kind) | ({} if run_name is None else {"run_name": run_name})
    write_whole(run_dir / ENVIRONMENT_FILE, json.dumps(content, indent=2))


def kind_of(run_dir: Path) -> Kind:
    """Return the kind of a run from its environment file; live if the file is missing."""
    content = read_object(run_dir / ENVIRONMENT_FILE)
    return "simulated" if content.get("kind") == "simulated" else "live"


def changed_since(run_dir: Path) -> list[str]:
    """Return the changes since the run that may affect its arithmetic, in words."""
    recorded_environment, current_environment = read_object(run_dir / ENVIRONMENT_FILE), environment("live")
    packages = recorded_environment.get("packages")
    packages = packages if isinstance(packages, dict) else {}
    keys = ("python", "machine", "processor")
    pairs = [
        *((key, recorded_environment.get(key), current_environment[key]) for key in keys),
        *((name, packages.get(name), current_environment["packages"][name]) for name in _ARITHMETIC),
    ]
    return [f"{name} was {old}, is {new}" for name, old, new in pairs if old != new]


@cache
def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()
