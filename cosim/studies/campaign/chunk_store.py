"""A campaign's folder: the runs in Parquet files, each written completely or not at all.

``FOLDER/runs/point-00003/draws-000004000.parquet`` holds the runs from number 4,000 on of grid
point 3. Each row has the values of the axes and the metrics of one run. A chunk with a file is not
computed again.
"""

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from cosim.record.run_directory import CAMPAIGN_FILE, LATEST, SCENARIO_FILE, SUMMARY_FILE, require_folder
from cosim.studies.campaign.arithmetic import arithmetic, difference
from cosim.studies.campaign.campaign_file import Campaign
from cosim.studies.campaign.campaign_grid import Point, row_type
from cosim.studies.campaign.campaign_workers import Chunk, LostWorkersError, OtherArithmeticError, Runner
from netem.core.errors import CallerError, ExitStatus, MachineError, NoackError, why
from netem.core.file_access import PARTIAL, create_folder, locked, remove_file, write_whole
from netem.core.json_text import parse_json
from noack.core.progress import Progress, no_progress

RUNS = "runs"
_LOCK = ".lock"
_FORMAT = 1
"""Version of the files; those of another one are not read."""
MOST_FILES = 1_000_000


class Store:
    """The chunks of a campaign: ``draws`` runs at each point, ``size`` draws per chunk.

    Raises:
        CallerError: there would be too many files.
    """

    def __init__(self, folder: Path, points: Sequence[Point], draws: int, size: int) -> None:
        if (count := len(points) * -(-draws // size)) > MOST_FILES:
            raise CallerError(
                f"draws = {draws}, chunk = {size}: the results would be {count:,} files; "
                f"at most {MOST_FILES:,}: give fewer draws, or a larger chunk"
            )
        self.folder, self.points, self.draws = folder, points, draws
        self._size = size
        text, number = pa.dictionary(pa.int16(), pa.string()), pa.float64()
        axes = points[0].values.items()
        self.row_type = row_type(points)
        self._schema = pa.schema(
            [
                *((name, text if isinstance(value, str) else number) for name, value in axes),
                ("draw", pa.int64()),
                *((name, pa.from_numpy_dtype(self.row_type[name])) for name in self.row_type.names or ()),
            ]
        )

    def chunks(self, point: int) -> Iterator[Chunk]:
        """Return all chunks of a point."""
        for start in range(0, self.draws, self._size):
            yield Chunk(point, start, min(start + self._size, self.draws))

    def missing(self) -> Iterator[Chunk]:
        """Return the chunks without a file, ordered by draw and then by point."""
        for chunks in zip(*(self.chunks(point.number) for point in self.points), strict=True):
            yield from (chunk for chunk in chunks if not self._is_complete(chunk))

    def write(self, chunk: Chunk, rows: NDArray[np.void]) -> None:
        """Write a chunk completely or not at all.

        Raises:
            MachineError: the file cannot be written.
        """
        columns: dict[str, Any] = {
            name: pa.array([value] * len(rows), self._schema.field(name).type)
            for name, value in self.points[chunk.point].values.items()
        }
        columns["draw"] = np.arange(chunk.start, chunk.stop)
        columns |= {name: np.ascontiguousarray(rows[name]) for name in self.row_type.names or ()}
        buffer = io.BytesIO()
        table = pa.table(columns, self._schema)
        pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
        write_whole(self._path(chunk), buffer.getvalue())

    def columns(self, point: int, names: Sequence[str]) -> dict[str, NDArray[np.generic]]:
        """Return columns of all runs at a point, by draw, (draws,) each.

        Raises:
            MachineError: a file cannot be read.
        """
        parts: dict[str, list[NDArray[np.generic]]] = {name: [] for name in names}
        for chunk in self.chunks(point):
            path = self._path(chunk)
            try:
                table = pq.read_table(path, columns=list(names), page_checksum_verification=True)
            except (OSError, pa.ArrowException):
                raise MachineError(
                    f"{path}: cannot be read, or is damaged; remove it, and the same command "
                    "computes it again"
                ) from None
            for name in names:
                parts[name].append(table[name].to_numpy()[: len(chunk.draws)])
        return {name: np.concatenate(part) for name, part in parts.items()}

    def _is_complete(self, chunk: Chunk) -> bool:
        """Whether the chunk's file is valid; it may have more rows, if draws was larger before."""
        try:
            table = pq.read_metadata(self._path(chunk))
        except (OSError, pa.ArrowException):
            return False
        return bool(
            table.num_rows >= len(chunk.draws) and table.schema.to_arrow_schema().names == self._schema.names
        )

    def _path(self, chunk: Chunk) -> Path:
        return self.folder / RUNS / f"point-{chunk.point:05}" / f"draws-{chunk.start:09}.parquet"


@contextmanager
def locked_folder(campaign: Campaign, base: Mapping[str, object], store: Store) -> Iterator[None]:
    """Lock a campaign's folder: a new folder, or one of the same campaign.

    The number of draws and the figures may differ from earlier. If no run is missing, code and
    libraries may differ, too. ``base`` is the content of the scenario of all runs.

    Raises:
        CallerError: the folder has another campaign, or runs of other code or libraries, or another
            noack process uses it.
        MachineError: the folder cannot be created.
    """
    folder = store.folder
    manifest = {
        "format": _FORMAT,
        "campaign": _identity(campaign),
        "scenario": base,
        # The entries above do not contain defaults, or the files that the scenario names.
        "scenario_resolved": blake2b(
            "".join(point.scenario.model_dump_json() for point in store.points).encode(),
            digest_size=16,
        ).hexdigest(),
        "arithmetic": arithmetic(),
    }
    manifest = json.loads(json.dumps(manifest, default=str))
    with ExitStack() as stack:
        _refuse_runs(folder)
        try:
            create_folder(folder)
            if not stack.enter_context(locked(folder / _LOCK)):
                raise CallerError(f"{folder}: another noack uses this folder")
            made_by = _claim(folder, manifest)
            for scratch in (folder / RUNS).glob(f"*/.*{PARTIAL}"):
                remove_file(scratch)
        except OSError as error:
            raise MachineError(f"{folder}: cannot be written: {why(error)}") from None
        deviation = difference(made_by, arithmetic())
        if deviation is not None and next(store.missing(), None) is not None:
            raise CallerError(
                f"{folder}: cannot be continued, new results would differ from the existing ones "
                f"({deviation}); give another --out, or remove the folder"
            )
        yield


def _refuse_runs(folder: Path) -> None:
    """Raise CallerError for a folder with results that are no campaign's; nothing is written there."""
    require_folder(folder)
    if (folder / CAMPAIGN_FILE).exists():
        return
    if any((folder / name).exists() for name in (RUNS, SUMMARY_FILE, SCENARIO_FILE)):
        raise CallerError(f"{folder}: holds results, but no {CAMPAIGN_FILE}; give another --out")
    if (folder / LATEST).is_symlink() or any(folder.glob(f"*/{SCENARIO_FILE}")):
        raise CallerError(f"{folder}: a folder of run directories; give another --out")


def _claim(folder: Path, manifest: Mapping[str, object]) -> Mapping[str, str]:
    """Write or check the folder's manifest; return the code and libraries of its runs."""
    path = folder / CAMPAIGN_FILE
    try:
        stored_manifest = parse_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        write_whole(path, json.dumps(manifest, indent=1))
        stored_manifest = dict(manifest)
    except ValueError:
        stored_manifest = None
    if not isinstance(stored_manifest, dict) or not isinstance(stored_manifest.get("arithmetic"), dict):
        raise CallerError(f"{path}: not a manifest of a campaign; give another --out")
    made_by: dict[str, str] = stored_manifest.pop("arithmetic")
    mismatch = difference(stored_manifest, {k: v for k, v in manifest.items() if k != "arithmetic"})
    if mismatch is not None:
        raise CallerError(
            f"{folder}: holds another campaign ({mismatch}); give another --out, or remove the folder"
        )
    return made_by


def _identity(campaign: Campaign) -> dict[str, object]:
    """Return the settings on which the results depend."""
    content = campaign.model_dump(
        mode="json",
        exclude={"draws", "description", "figures", "compare"},
    )
    del content["metrics"]["shown"]
    for axis in content["axes"]:
        del axis["title"]
    return content


class InterruptedCampaignError(NoackError):
    """A user or a signal interrupted the campaign; written runs are kept."""

    def __init__(self, message: str, exit_status: ExitStatus) -> None:
        super().__init__(message)
        self.exit_status = exit_status


def run_campaign(store: Store, runner: Runner, progress: Progress = no_progress) -> int:
    """Compute the missing runs; return their number.

    Raises:
        InterruptedCampaignError: a signal was received.
        LostWorkersError: workers have died.
        MachineError: the results cannot be written.
    """
    total = len(store.points) * store.draws

    def stored() -> int:
        return total - sum(len(chunk.draws) for chunk in store.missing())

    stored_before = runs_done = stored()
    progress(runs_done, total)

    def message(ending: object) -> str:
        return (
            f"{ending}; {runs_done:,} of {total:,} runs are in {store.folder}; "
            "the same command continues the campaign"
        )

    try:
        for chunk, rows in runner([point.work for point in store.points], list(store.missing())):
            store.write(chunk, rows)
            runs_done += len(chunk.draws)
            progress(runs_done, total)
    except KeyboardInterrupt as error:
        status = getattr(error, "exit_status", ExitStatus.INTERRUPTED)
        runs_done = stored()  # it may have come after a chunk was written, and before it was counted
        raise InterruptedCampaignError(message(str(error) or "interrupted"), status) from None
    except (LostWorkersError, OtherArithmeticError, MachineError) as error:
        raise type(error)(message(error)) from None
    return total - stored_before
