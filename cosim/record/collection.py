"""Collects what processes on other hosts kept of a run, because they could not send it.

Each process writes files of its own, named after it. They are copied into the spool of the run,
from which its record is completed again.
"""

import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cosim.record.run_directory import ENVIRONMENT_FILE, read_object
from noack.core.errors import CallerError, MachineError, PeerError, why
from noack.runtime.spool import SPOOL, kept_run_name


def collect(run_dir: Path, source: str) -> int:
    """Copy what was kept in ``FOLDER``, or in ``HOST:FOLDER``, into a run's spool.

    Files that were copied before are copied again: rows that are there twice count once.

    Returns:
        The number of files.

    Raises:
        CallerError: nothing of this run is there.
        PeerError: the host cannot be reached.
        MachineError: a file cannot be copied.
    """
    with _reachable(source) as folder:
        found = sorted(path for path in (folder / SPOOL).glob("*.*") if path.is_file())
        if not found:
            raise CallerError(f"{source}: nothing was kept there (no files in {SPOOL}/)")
        if kept_run_name(folder) != read_object(run_dir / ENVIRONMENT_FILE).get("run_name"):
            raise CallerError(f"{source}: it was kept of another run than {run_dir}")
        try:
            (run_dir / SPOOL).mkdir(exist_ok=True)
            for path in found:
                shutil.copyfile(path, run_dir / SPOOL / path.name)
        except OSError as error:
            raise MachineError(f"{run_dir / SPOOL}: cannot be written: {why(error)}") from None
    return len(found)


@contextmanager
def _reachable(source: str) -> Iterator[Path]:
    """Give a folder of this host: the source itself, or a copy from another host by scp."""
    host, colon, path = source.partition(":")
    if not colon or "/" in host or Path(source).exists():
        yield Path(source)
        return
    with tempfile.TemporaryDirectory() as folder:
        # A file name may begin with a dash, and a host name must not be taken for an option.
        command = ["scp", "-q", "-r", "--", f"{host}:{path}", f"{folder}/kept"]
        try:
            subprocess.run(command, check=True, capture_output=True, text=True)
        except FileNotFoundError:
            raise MachineError(
                f"{source}: no scp here; copy the folder, and give its path here"
            ) from None
        except subprocess.CalledProcessError as error:
            lines = error.stderr.strip().splitlines()
            # ssh's reason is above the last line.
            reason = [line for line in lines if line != "scp: Connection closed"] or ["scp failed"]
            reason = reason[-1]
            raise PeerError(f"{source}: {reason}") from None
        yield Path(folder) / "kept"
