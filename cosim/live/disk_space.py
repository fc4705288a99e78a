"""Room on the disk: what a run will take, said before it begins."""

import shutil
import sys
from pathlib import Path

from cosim.record.run_directory import LEAST_FREE_BYTES
from noack.config.resolution import tables_of
from noack.config.scenario import Scenario
from noack.core.errors import MachineError
from noack.protocol.record_tables import (
    CONTROLLER_STEP,
    PLANT_ACTUATION,
    PLANT_STEP,
    SENSOR_MEASUREMENT,
)

_UNTIL_THE_END = 3
"""While a run ends, its spool, its record and its view lie side by side, each about as large."""


def spool_bytes(resolved: Scenario) -> int:
    """What the rows of a run's grids take, without those of events, of which nobody knows."""
    steps = resolved.timing.horizon_ns // resolved.timing.plant_period_ns + 1
    ticks = resolved.timing.horizon_ns // resolved.timing.controller_period_ns
    counts = {
        PLANT_STEP: steps,
        SENSOR_MEASUREMENT: steps // resolved.plant.measure_every,
        CONTROLLER_STEP: ticks,
        PLANT_ACTUATION: ticks,
    }
    types = tables_of(resolved)
    return sum(rows * types[table].itemsize for table, rows in counts.items())


def needed_bytes(resolved: Scenario) -> int:
    """What a run takes on the disk until it has ended."""
    return _UNTIL_THE_END * spool_bytes(resolved)


def require_disk_space(resolved: Scenario, runs: Path) -> None:
    """Check that a run's record fits on the disk; warn if it may not.

    Args:
        resolved: the resolved scenario.
        runs: where the run directory will be made; it need not exist.

    Raises:
        MachineError: what will be recorded is more than there is room for.
    """
    folder = next((one for one in (runs, *runs.absolute().parents) if one.is_dir()), None)
    if folder is None:
        return
    free, spool = shutil.disk_usage(folder).free, spool_bytes(resolved)
    if free >= _UNTIL_THE_END * spool or free < LEAST_FREE_BYTES:  # which nothing can begin with
        return
    text = (
        f"{runs}: this run records {_size(spool)} and takes {_size(_UNTIL_THE_END * spool)} until "
        f"it has ended; {_size(free)} are free on the disk"
    )
    if free < spool:
        raise MachineError(f"{text}; shorten horizon_s, or name another place by --runs")
    print(f"noack: warning: {text}", file=sys.stderr)


def _size(count: int) -> str:
    for unit in ("bytes", "KiB", "MiB", "GiB", "TiB", "PiB"):
        if count < 1024 or unit == "PiB":
            break
        count //= 1024
    return f"{count} {unit}"
