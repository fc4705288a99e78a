"""The environment of a run, stored with it: versions, computer, command."""

import json
import platform
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

from cosim.record.run_directory import ENVIRONMENT_FILE, read_object
from noack.core.file_access import write_whole
from noack.core.process_limits import cores

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
    stored = read_object(run_dir / ENVIRONMENT_FILE)
    return "simulated" if stored.get("kind") == "simulated" else "live"


def changed_since(run_dir: Path) -> list[str]:
    """Return the changes since the run that may affect its arithmetic, in words."""
    return _changes(run_dir, ("python", "machine", "processor"), _ARITHMETIC)


def all_changes_since(run_dir: Path) -> list[str]:
    """Return all changes of versions and machine since the run, in words."""
    return _changes(run_dir, ("python", "system", "machine", "processor", "cores"), _PACKAGES)


def _changes(run_dir: Path, keys: Sequence[str], names: Sequence[str]) -> list[str]:
    then, now = read_object(run_dir / ENVIRONMENT_FILE), environment("live")
    packages = then.get("packages")
    packages = packages if isinstance(packages, dict) else {}
    pairs = [
        *((key, then.get(key), now[key]) for key in keys),
        *((name, packages.get(name), now["packages"][name]) for name in names),
    ]
    return [f"{name} was {old}, is {new}" for name, old, new in pairs if old != new]


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
