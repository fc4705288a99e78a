"""Makes the directory of a run that ended without a recorder: ``_spooled_run SECONDS FOLDER``.

The run is simulated; its rows are spooled as those of a live run are: in batches of 50 ms, with the
rows of all loops in the order of time. The path of the run directory is printed. A scenario with
several loops may be named: ``_spooled_run SECONDS FOLDER SCENARIO``.
"""

import shutil
import sys
from pathlib import Path

import numpy as np

from cosim.live.simulated_run import simulate_run
from cosim.record.record_source import joined
from cosim.record.run_directory import RECORD, write_environment
from cosim.record.table_files import TableFile
from noack.config.resolution import run_tables
from noack.config.scenario_file import load
from noack.protocol.topology import RECORDER
from noack.runtime.spool import SPOOL, SpoolWriter

SCENARIO = Path(__file__).parents[1] / "scenarios" / "lane_following.toml"
_BATCH_NS = 50_000_000
_SETTINGS = ("trigger.floor=1e-3",)  # without a floor, the threshold vanishes within an hour


def spool(run_dir: Path, types: dict[str, np.dtype[np.void]]) -> None:
    """Turn the record of a run into a spool."""
    writer = SpoolWriter(run_dir / SPOOL, RECORDER)
    for table, dtype in types.items():
        file = TableFile(run_dir / RECORD / f"{table}.parquet", dtype)
        rows = joined([*file.batches()], dtype)
        rows = rows.take(np.argsort(rows["now_ns"], kind="stable"))
        ends_ns = np.arange(_BATCH_NS, rows["now_ns"].max(initial=0) + _BATCH_NS, _BATCH_NS)
        first = 0
        for batch in np.split(rows, np.searchsorted(rows["now_ns"], ends_ns)):
            if len(batch):
                writer.append(table, first, batch.tobytes())
                first += len(batch)
    writer.close()
    shutil.rmtree(run_dir / RECORD)


def main(horizon_s: str, folder: str, path: str = "") -> None:
    """Simulate and spool a run."""
    settings = (*(() if path else _SETTINGS), f"horizon_s={horizon_s}")
    scenario = load(Path(path) if path else SCENARIO, settings)
    run_dir = simulate_run(scenario, Path(folder)).run_dir
    write_environment(run_dir, "live")
    spool(run_dir, dict(run_tables(scenario)))
    print(run_dir)


if __name__ == "__main__":
    main(*sys.argv[1:])
