"""Makes the directory of a run that ended without a recorder: ``_spooled_run SECONDS FOLDER``.

The run is simulated; its rows are spooled in the batches of a live run, 50 ms long. The path of the
run directory is printed.
"""

import shutil
import sys
from pathlib import Path

from cosim.live.simulated_run import simulate_run
from cosim.record.record_source import with_loop
from cosim.record.run_directory import RECORD, write_environment
from cosim.record.run_record import RunRecord, load_record
from noack.config.resolution import run_tables
from noack.config.scenario_file import load
from noack.protocol.topology import RECORDER
from noack.runtime.spool import SPOOL, SpoolWriter

SCENARIO = Path(__file__).parents[1] / "scenarios" / "lane_following.toml"
_BATCH_ROWS = 25
_SETTINGS = ("trigger.floor=1e-3",)  # without a floor, the threshold vanishes within an hour


def spool(record: RunRecord, run_dir: Path) -> None:
    """Spool all rows of a run of one loop."""
    writer, types = SpoolWriter(run_dir / SPOOL, RECORDER), run_tables(record.scenario)
    for table in record.tables:
        first = 0
        for rows in record.source.batches(table):
            for place in range(0, len(rows), _BATCH_ROWS):
                batch = with_loop(rows[place : place + _BATCH_ROWS], 0, types[table])
                writer.append(table, first, batch.tobytes())
                first += len(batch)
    writer.close()


def main(horizon_s: str, folder: str) -> None:
    """Simulate and spool a run."""
    scenario = load(SCENARIO, (*_SETTINGS, f"horizon_s={horizon_s}"))
    run_dir = simulate_run(scenario, Path(folder)).run_dir
    write_environment(run_dir, "live")
    spool(load_record(run_dir), run_dir)
    shutil.rmtree(run_dir / RECORD)
    print(run_dir)


if __name__ == "__main__":
    main(*sys.argv[1:])
