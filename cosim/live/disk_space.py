"""Whether a run's record fits on the disk."""

import shutil
import sys
from pathlib import Path

from cosim.record.run_directory import LEAST_FREE_BYTES
from noack.core.errors import MachineError
from noack.core.number_format import byte_size
from noack.protocol.record_tables import CONTROLLER_STEP, PLANT_ACTUATION, PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import tables_of
from noack.scenario.scenario import Scenario, loop_scenario, loop_sections

_COPIES_AT_END = 3
"""At the end of a run, spool, record and view exist together, each of about the same size."""


def spool_bytes(resolved: Scenario) -> int:
    """Bytes of the rows on fixed time grids; the number of event rows is not known in advance."""
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
    """Bytes on the disk until the run has ended."""
    return _COPIES_AT_END * spool_bytes(resolved)


def require_disk_space(run: Scenario, runs: Path) -> None:
    """Check that a run's record fits on the disk; warn if it may not.

    ``run`` is the scenario of the run, resolved. Raise MachineError if the record needs more than the
    free space.
    """
    folder = next((path for path in (runs, *runs.absolute().parents) if path.is_dir()), None)
    if folder is None:
        return
    sections = loop_sections(run)
    spool = sum(section.count * spool_bytes(loop_scenario(run, section)) for section in sections)
    free = shutil.disk_usage(folder).free
    if free >= _COPIES_AT_END * spool or free < LEAST_FREE_BYTES:  # then no run can begin at all
        return
    most = byte_size(_COPIES_AT_END * spool)
    text = (
        f"{runs}: this run records {byte_size(spool)} and needs {most} until its end; "
        f"{byte_size(free)} are free on the disk"
    )
    if free < spool:
        raise MachineError(f"{text}; reduce horizon_s, or choose another disk with --runs")
    print(f"noack: warning: {text}", file=sys.stderr)
