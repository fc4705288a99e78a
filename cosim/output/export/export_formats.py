"""The formats of exports, and what they write: a run, or one of its loops."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from cosim.analysis.summary.summary_model import read_summary
from cosim.record import data_frames
from cosim.record.run_directory import ENVIRONMENT_FILE, SUMMARY_FILE, read_object, require_output
from cosim.record.run_record import Notice, RunRecord, load_run
from netem.core.errors import CallerError
from netem.core.extension_points import missing_extension, parts
from noack.scenario.scenario import Scenario

_ENDING = "_export"


@runtime_checkable
class ExportFormat(Protocol):
    """What a module ``NAME_export`` has."""

    SUFFIX: str
    """Ending of its files; empty: a folder."""

    def write(self, run: "ExportedRun", path: Path, *, certificates: bool) -> list[Path]:
        """Write a run; return the written files. Raise MachineError if a file cannot be written."""


@dataclass(frozen=True)
class ExportedRun:
    """A run, or one of the loops of a run."""

    directory: Path
    record: RunRecord
    """Of the only loop, or of the network that the loops share."""
    summary: dict[str, object]
    """The content of ``summary.json``, or its part about the loop."""
    loops: "Sequence[ExportedRun]" = ()
    """The loops that share the network."""
    name: str = ""
    """Of the loop; empty for the run itself."""
    phase_ns: int = 0
    """Time of the run at which the loop's own time begins."""

    @property
    def scenario(self) -> Scenario:
        """The resolved scenario of the loop, or of the run."""
        return self.record.scenario

    @property
    def tables(self) -> Mapping[str, np.dtype[np.void]]:
        """The tables of the record, each with the type of its rows; ``docs/record.md`` has them."""
        return self.record.tables

    @property
    def is_network(self) -> bool:
        """Whether this is the network of several loops, of which ``loops`` has the others' tables."""
        return self.record.is_network

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Names of the loop's states and of its inputs."""
        return self.record.loop.state_names, self.record.loop.input_names

    @property
    def notices(self) -> Sequence[Notice]:
        """The lines of the run's log, each with ``t_ns``, ``level``, ``text`` and ``process``."""
        return self.record.notices

    def parts(self, *tables: str) -> Iterator[Mapping[str, NDArray[np.void]]]:
        """Yield the rows of some tables, as structured arrays, in consecutive parts of the run.

        A short run is one part. Those of a long one fit into memory.
        """
        return self.record.slices(*tables)

    def samples(self) -> pa.Table:
        """Return plant, sensor and controller of a loop on one time grid, as ``noack.Run.samples``."""
        return data_frames.samples(self.record)

    @property
    def environment(self) -> dict[str, object]:
        """The content of ``environment.json``."""
        return read_object(self.directory / ENVIRONMENT_FILE) | {"kind": self.record.kind}


def export_run(
    run_dir: Path,
    path: Path,
    file_format: str | None = None,
    *,
    loop: str | None = None,
    certificates: bool = True,
) -> list[Path]:
    """Export a run; return the written files.

    Args:
        run_dir: the run directory, which has a summary.
        path: the file, or the folder.
        file_format: its name; by default that of the path's ending.
        loop: name of the loop to export; by default the whole run.
        certificates: whether a file of MATLAB has the certificates of each loop.

    Raises:
        CallerError: the ending is not that of a format, it is not a run directory, or the record is
            damaged.
        MachineError: a file cannot be written.
    """
    suffixes = {name: each.SUFFIX for name, each in formats().items()}
    by_ending = {suffix: name for name, suffix in reversed(suffixes.items())}  # noack's own first
    chosen = by_ending.get(path.suffix) if file_format is None else file_format
    if chosen is None or suffixes[chosen] not in ("", path.suffix):
        *first, last = (suffix or "a folder" for suffix in suffixes.values())
        expected = f"{', '.join(first)} or {last}" if file_format is None else suffixes[file_format]
        missing = missing_extension("noack.exports", path.suffix.removeprefix("."))
        raise CallerError(f"{path}: {missing or f'an export is written to {expected}'}")
    require_output(path, is_folder=not suffixes[chosen])
    return formats()[chosen].write(_exported_run(run_dir, loop), path, certificates=certificates)


@cache
def formats() -> Mapping[str, ExportFormat]:
    """Return the formats by their names: those of this folder, and those of installed extensions."""

    def read(module: ModuleType) -> tuple[str, ExportFormat] | None:
        name = module.__name__.rpartition(".")[2]
        is_format = name.endswith(_ENDING) and isinstance(module, ExportFormat)
        return (name.removesuffix(_ENDING), module) if is_format else None

    own_folder = __name__.rpartition(".")[0]
    return dict(parts(own_folder, "noack.exports", read))


def find_format(name: str) -> ExportFormat:
    """Return a format by its name.

    Raises:
        CallerError: there is none.
    """
    if name not in formats():
        missing = missing_extension("noack.exports", name)
        reason = missing or f"must be one of {', '.join(formats())}"
        raise CallerError(f"format {name}: {reason}")
    return formats()[name]


def _exported_run(run_dir: Path, loop: str | None) -> ExportedRun:
    """Return a run directory, or one of its loops, for an export.

    Raises:
        CallerError: it is not a run directory, its record is damaged, or there is no such loop.
    """
    run, content = load_run(run_dir), read_object(run_dir / SUMMARY_FILE)
    if loop is not None or not run.names[1:]:
        record = run.loop(loop)
        summary = read_summary(content)
        loop_summary = summary.of_loop(record.scenario.name).to_json() if summary else content
        return ExportedRun(run_dir, record, loop_summary)
    parts = content.get("loops")
    by_name = dict(zip(run.names, parts if isinstance(parts, list) else [], strict=False))
    loops = [
        ExportedRun(run_dir, record, by_name.get(name, {}), (), name, phase_ns)
        for name, record, phase_ns in zip(run.names, run.loops, run.phases_ns, strict=True)
    ]
    return ExportedRun(run_dir, run.network, content, loops)
