"""Archives of runs, and their repetition with what differs.

An archive is one ZIP file with everything that the repetition of a run needs. The entries are
stored, not compressed: the record is compressed already, so that the same run gives the same bytes,
and no entry is larger than the file. ``archive.json``, the first entry, has the size and the
SHA-256 of every other one.
"""

import hashlib
import os
import re
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path
from typing import IO, Annotated, Literal, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rich.console import Console
from rich.text import Text

from cosim.analysis.replay import replay
from cosim.analysis.replay.replay_result import difference, first_row_difference
from cosim.analysis.summary.summary_model import ReplayDifference
from cosim.live.finalize import finalize, reopen
from cosim.output.result_tables import ResultTable, terminal_table
from cosim.output.run_tables import network_rows
from cosim.record.record_source import Slice
from cosim.record.run_directory import (
    ENDING_FILE,
    ENVIRONMENT_FILE,
    RECORD,
    REPORTS_FILE,
    SCENARIO_FILE,
    SUMMARY_FILE,
    Kind,
    all_changes_since,
    kind_of,
)
from cosim.record.run_record import RecordedRun, RunRecord, load_run, steps_of
from cosim.simulation.virtual_time import simulate_run
from cosim.studies.run_comparison import compare_runs
from noack.core.errors import CallerError, MachineError, one_line, printable, why
from noack.core.file_access import new_file, open_regular
from noack.core.number_format import number
from noack.scenario.scenario import Scenario, loops_of
from noack.scenario.scenario_file import MOST_RECORDED_BYTES, load
from noack.settings.user_files import FILE_TABLES, Sha256, file_tables

MANIFEST = "archive.json"
SUFFIX = ".noack.zip"
_FILES = {SCENARIO_FILE, ENVIRONMENT_FILE, REPORTS_FILE, ENDING_FILE, SUMMARY_FILE}
_FOLDERS = {RECORD, "logs", *(table.split(".")[0] for table in FILE_TABLES)}
_MOST_ENTRIES = 1_000_000
_MOST_MANIFEST_BYTES = 256 * 2**20
_CHUNK_BYTES = 2**20
_PART = re.compile(r"[^\x00-\x1f\x7f/\\:]{1,255}")
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time that ZIP has


class Entry(BaseModel):
    """Size and checksum of a file of an archive."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    bytes: Annotated[int, Field(ge=0)]
    sha256: Sha256


class Manifest(BaseModel):
    """The content of ``archive.json``."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    format: Literal["noack run archive 2"] = "noack run archive 2"
    scenario: str
    kind: Kind
    files: dict[str, Entry]


def write_archive(run_dir: Path, path: Path) -> Manifest:
    """Write the archive of a run, which is finalised first if necessary.

    Raises:
        CallerError: it is not a run directory, the run is active, its scenario names files
            elsewhere, or a table of its record is missing or cannot be opened.
        MachineError: a file cannot be read, or the archive cannot be written.
    """
    reopen(run_dir)
    scenario = load(run_dir / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    if (outside := outside_files(scenario, run_dir)) is not None:
        raise CallerError(f"{run_dir}: its scenario names {outside}, outside the run directory")
    load_run(run_dir)  # refuses a damaged record
    try:
        names = sorted(_names(run_dir))
        files = {name: _entry(run_dir / name) for name in names}
        manifest = Manifest(scenario=scenario.name, kind=kind_of(run_dir), files=files)
        with new_file(path) as target, zipfile.ZipFile(target, "w") as archive:
            content = manifest.model_dump_json(indent=1).encode()
            archive.writestr(_info(MANIFEST, len(content)), content)
            for name, entry in files.items():
                with open_regular(run_dir / name) as source:
                    _copy_in(source, archive, _info(name, entry.bytes))
    except (OSError, ValueError) as error:
        reason = why(error) if isinstance(error, OSError) else str(error)
        raise MachineError(f"{path}: the archive cannot be written: {reason}") from None
    return manifest


def unpack(path: Path, folder: Path) -> Manifest:
    """Check an archive, and write its files into a folder, which is empty.

    Raises:
        CallerError: the file is not such an archive, is damaged, or names files elsewhere.
        MachineError: the folder cannot be written.
    """
    if path.is_dir():
        raise CallerError(f"{path}: a folder, not an archive; `noack archive` makes one of a run")
    try:
        with open_regular(path) as file, zipfile.ZipFile(file) as archive:
            infos = _checked_entries(path, archive, os.fstat(file.fileno()).st_size)
            manifest = _manifest(path, archive)
            if missing := sorted(manifest.files.keys() ^ (infos.keys() - {MANIFEST})):
                raise CallerError(
                    f"{path}: {MANIFEST} and the archive do not have the same files, e.g. "
                    f"{printable(missing[0])}"
                )
            for name, entry in manifest.files.items():
                _copy_out(archive, infos[name], folder / name, entry, f"{path}: {name}")
    except (zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError, ValueError) as error:
        raise CallerError(f"{path}: not an archive of a run: {one_line(error)}") from None
    except OSError as error:
        prefix = f"{path}: " if error.filename in (None, str(path)) else f"{folder}: "
        kind = CallerError if prefix.startswith(f"{path}:") else MachineError
        raise kind(f"{prefix}{why(error)}") from None
    return manifest


def outside_files(scenario: Scenario, folder: Path) -> str | None:
    """Return a file that a scenario names outside a folder; None if there is none."""
    for part in (scenario, *loops_of(scenario)):
        for _, table in file_tables(part):
            if not Path(table.file or "").resolve().is_relative_to(folder.resolve()):
                return table.file
    return None


def _names(folder: Path) -> Iterator[str]:
    """Yield the files of a run directory that an archive has, as POSIX paths relative to it."""
    for path in folder.iterdir():
        if path.name in _FILES:
            yield path.name
        elif path.name in _FOLDERS and path.is_dir():
            yield from (f"{path.name}/{inner.name}" for inner in path.iterdir() if inner.is_file())


def _entry(path: Path) -> Entry:
    with open_regular(path) as file:
        digest = hashlib.file_digest(file, "sha256")  # type: ignore[arg-type]
        return Entry(bytes=file.tell(), sha256=digest.hexdigest())


def _info(name: str, size: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _EPOCH)
    info.create_system, info.external_attr, info.file_size = 3, 0o644 << 16, size
    return info


def _copy_in(source: IO[bytes], archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> None:
    with archive.open(info, "w") as target:
        while chunk := source.read(_CHUNK_BYTES):
            target.write(chunk)


def _checked_entries(path: Path, archive: zipfile.ZipFile, most_bytes: int) -> dict[str, zipfile.ZipInfo]:
    """Return the entries by name; refuse what no archive of noack's has."""
    infos = archive.infolist()
    if len(infos) > _MOST_ENTRIES:
        raise CallerError(f"{path}: has {len(infos):,} entries, more than an archive may have")
    entries: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        name, shown_name = info.filename, printable(info.filename)
        parts = name.split("/")
        if not all(_PART.fullmatch(part) and part not in (".", "..") for part in parts):
            raise CallerError(f"{path}: {shown_name}: not the name of a file in a run directory")
        if name != MANIFEST and not (
            (len(parts) == 1 and parts[0] in _FILES) or (len(parts) == 2 and parts[0] in _FOLDERS)
        ):
            raise CallerError(f"{path}: {shown_name}: an archive has no such file")
        if name in entries:
            raise CallerError(f"{path}: {shown_name}: is there twice")
        if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
            raise CallerError(f"{path}: {shown_name}: is compressed; noack's archives are not")
        entries[name] = info
    if sum(info.file_size for info in infos) > most_bytes:
        raise CallerError(f"{path}: its entries overlap")
    if MANIFEST not in entries:
        raise CallerError(f"{path}: not an archive of a run: has no {MANIFEST}")
    return entries


def _manifest(path: Path, archive: zipfile.ZipFile) -> Manifest:
    if archive.getinfo(MANIFEST).file_size > _MOST_MANIFEST_BYTES:
        raise CallerError(f"{path}: {MANIFEST} is too large")
    try:
        return Manifest.model_validate_json(archive.read(MANIFEST))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"])) or "content"
        raise CallerError(f"{path}: {MANIFEST}: {printable(key)}: {first['msg']}") from None


def _copy_out(archive: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path, entry: Entry, name: str) -> None:
    """Write an entry, and check its size and its SHA-256."""
    digest, size = hashlib.sha256(), 0
    target.parent.mkdir(parents=True, exist_ok=True)
    with archive.open(info) as source, target.open("xb") as file:
        while chunk := source.read(_CHUNK_BYTES):
            digest.update(chunk)
            size += len(chunk)
            file.write(chunk)
    if (size, digest.hexdigest()) != (entry.bytes, entry.sha256):
        raise CallerError(f"{printable(name)}: is damaged: its SHA-256 is not that of {MANIFEST}")


_MOST_STEPS = 1_000_000
"""A run with more steps is repeated on request only."""
_US_PER_STEP = 100.0
"""Of simulation, record, summary and comparison together."""


class Repetition(NamedTuple):
    """The repetition of an archived run."""

    scenario: str
    kind: Kind
    """Of the archived run. A live one is replayed; its simulation is shown beside it."""
    compared: int
    """Rows of a simulated run, inputs of a live one, that were compared bit for bit."""
    differences: Sequence[str]
    """The first difference of the run and of each of its loops, with table, row, column, values."""
    gaps: Sequence[str]
    """Parts of a live run's record that are missing."""
    changes: Sequence[str]
    """Versions and machine that differ from those of the archived run."""
    numbers: Sequence[tuple[str, ...]]
    """Key numbers that differ: name, archived, repeated; of a live run, those of its simulation."""

    @property
    def bit_exact(self) -> bool:
        """Whether something was compared, and nothing differs in any bit."""
        return bool(self.compared) and not self.differences

    def to_json(self) -> dict[str, object]:
        """Return the result for programs."""
        document = self._asdict() | {"numbers": [list(row) for row in self.numbers]}
        return {"bit_exact": self.bit_exact, **document}


def repeat_archive(
    path: Path, *, run_code: bool = False, long: bool = False, into: Path | None = None
) -> Repetition:
    """Unpack an archive, repeat its run, and compare.

    Args:
        path: the archive.
        run_code: whether to execute the files of plants, triggers and controllers that it contains.
        long: repeat a run of more than a million steps, too.
        into: folder, new or empty, for the unpacked run and its repetition; else they are deleted.

    Raises:
        CallerError: the file is not an archive, is damaged, or contains code without ``run_code``
            or a long run without ``long``.
        MachineError: a folder cannot be written.
    """
    with _folder(into) as folder, _naming_archive(path, archived := folder / "archived"):
        manifest = unpack(path, archived)
        scenario = _scenario(path, archived, run_code=run_code)
        if (manifest.scenario, manifest.kind) != (scenario.name, kind_of(archived)):
            raise CallerError(f"{path}: {MANIFEST} describes another run than the archive contains")
        if not long and (steps := steps_of(scenario)) > _MOST_STEPS:
            raise CallerError(
                f"{path}: its run has {steps:,} steps, and would take about "
                f"{steps * _US_PER_STEP * 1e-6 / 3600:.1f} hours; --long repeats it nevertheless"
            )
        recorded = load_run(archived)
        ending = simulate_run(scenario, folder / "repeated")
        finalize(ending, report=False, view=False)
        repeated = load_run(ending.run_dir)
        compare = _compare_replay if manifest.kind == "live" else _compare_repetition
        pairs = zip(_named_loops(recorded), _named_loops(repeated), strict=True)
        results = [compare(name, record, repeated_record) for (name, record), (_, repeated_record) in pairs]
        return Repetition(
            scenario=manifest.scenario,
            kind=manifest.kind,
            compared=sum(result.row_count for result in results),
            differences=[text for result in results for text in result.differences],
            gaps=[text for result in results for text in result.gaps],
            changes=all_changes_since(archived),
            numbers=_numbers(archived, ending.run_dir),
        )


class _Comparison(NamedTuple):
    row_count: int
    differences: Sequence[str]
    gaps: Sequence[str]


@contextmanager
def _folder(into: Path | None) -> Iterator[Path]:
    if into is None:
        with tempfile.TemporaryDirectory(prefix="noack-") as temporary:
            yield Path(temporary)
        return
    try:
        into.mkdir(parents=True, exist_ok=True)
        if any(into.iterdir()):
            raise CallerError(f"--into {into}: the folder is not empty")
    except OSError as error:
        raise MachineError(f"{into}: {why(error)}") from None
    yield into


@contextmanager
def _naming_archive(path: Path, folder: Path) -> Iterator[None]:
    """In messages about files of an archive, name the archive and not the folder they are in."""
    try:
        yield
    except CallerError as error:
        text = str(error).replace(f"{folder}/", f"{path}: ").replace(str(folder), str(path))
        raise CallerError(text) from None


def _scenario(path: Path, folder: Path, *, run_code: bool) -> Scenario:
    """Load the scenario of an unpacked archive; refuse code that is not wanted, or elsewhere."""
    if not (folder / SCENARIO_FILE).is_file():
        raise CallerError(f"{path}: not an archive of a run: has no {SCENARIO_FILE}")
    scenario = load(folder / SCENARIO_FILE, most_bytes=MOST_RECORDED_BYTES)
    if (outside := outside_files(scenario, folder)) is not None:
        raise CallerError(f"{path}: its scenario names {outside}, which is not in the archive")
    for part in (scenario, *loops_of(scenario)):
        for key, table in file_tables(part):
            if not run_code:
                name = Path(table.file or "").name
                raise CallerError(
                    f"{path}: contains code ({key}: {name}), which would be run with your "
                    "permissions; --run-code runs it"
                )
    return scenario


def _named_loops(run: RecordedRun) -> Iterator[tuple[str, RunRecord]]:
    """Yield the records of the loops with their names, and that of a network that they share."""
    if len(run.loops) == 1:  # its record has the rows of the network
        yield "", run.loops[0]
        return
    yield "", run.network
    for name, record in zip(run.names, run.loops, strict=True):
        yield f"loop {name}: ", record


def _compare_replay(name: str, archived: RunRecord, _: RunRecord) -> _Comparison:
    verdict = replay(archived)
    first = verdict.first_difference
    gaps = [f"{name}{gap}" for gap in verdict.gaps]
    return _Comparison(verdict.inputs, [] if first is None else [f"{name}{first}"], gaps)


def _compare_repetition(name: str, archived: RunRecord, repeated: RunRecord) -> _Comparison:
    first = first_difference(archived, repeated)
    count = sum(archived.count(table) for table in archived.tables)
    return _Comparison(count, [] if first is None else [f"{name}{first}"], [])


def first_difference(archived: RunRecord, repeated: RunRecord) -> ReplayDifference | None:
    """Return the first difference between the tables of two records, bit for bit."""
    rows_before = dict.fromkeys(archived.tables, 0)
    empty: Slice = {}
    for recorded, repetition in zip_longest(archived.slices(), repeated.slices(), fillvalue=empty):
        differences = [
            different
            for table in archived.tables
            if (different := _in_table(table, rows_before[table], recorded, repetition)) is not None
        ]
        if differences:
            return min(differences, key=lambda item: item.now_ns)
        for table in archived.tables:
            rows_before[table] += len(recorded[table])
    return None


def _in_table(table: str, rows_before: int, recorded: Slice, repetition: Slice) -> ReplayDifference | None:
    rows, repeated_rows = (part.get(table, np.zeros(0)) for part in (recorded, repetition))
    if rows.tobytes() == repeated_rows.tobytes():
        return None
    for i, (row, repeated_row) in enumerate(zip(rows, repeated_rows, strict=False)):
        if row.tobytes() != repeated_row.tobytes():
            return first_row_difference(table, rows_before + i, row, repeated_row)
    common, longer = min(len(rows), len(repeated_rows)), max(rows, repeated_rows, key=len)
    description = "the row is missing in the " + ("repetition" if len(rows) > common else "archive")
    return difference(table, rows_before + common, int(longer[common]["now_ns"]), description)


def _numbers(archived: Path, repeated: Path) -> list[tuple[str, ...]]:
    """Return the key numbers that differ, as text."""
    summaries = [reopen(run_dir, view=False).summary for run_dir in (archived, repeated)]
    if len(summaries[0].loops) > 1:
        first, second = (dict(network_rows(summary)) for summary in summaries)
        rows = [(name, value, second.get(name, "-")) for name, value in first.items()]
        return [row for row in rows if row[1] != row[2]]
    return [
        (key.name, *(number(value, 6) for value in key.values))
        for key in compare_runs([archived, repeated]).numbers
        if key.values[0] != key.values[1] and key.values != (None, 0.0)  # a distance of 0
    ]


def print_repetition(console: Console, result: Repetition) -> None:
    """Print what was compared, and what differs: bits, numbers, versions and machine.

    Texts of the archive are printed without control characters.
    """

    def print_text(text: str, style: str = "") -> None:
        console.print(Text(printable(text), style), soft_wrap=True)

    unit = "inputs replayed" if result.kind == "live" else "rows repeated"
    verdict = ("bit-exact", "green") if result.bit_exact else ("not reproduced", "bold red")
    if not result.compared:
        verdict = "nothing to compare", "bold red"
    print_text(f"{result.scenario}, {result.kind}: {verdict[0]}, {result.compared:,} {unit}", verdict[1])
    for text in result.differences:
        print_text(f"first difference: {text}")
    for text in result.gaps:
        print_text(f"record incomplete: {text}", "yellow")
    if result.numbers:
        no_lateness = ": the simulation has no lateness" if result.kind == "live" else ""
        rows = [[*map(printable, row)] for row in result.numbers]
        heads = ("quantity", "archived", "repeated")
        table = ResultTable("numbers", f"numbers that differ{no_lateness}", heads, rows)
        console.print(terminal_table(table))
    for change in result.changes:
        print_text(f"differs from the archived run's machine: {change}")
