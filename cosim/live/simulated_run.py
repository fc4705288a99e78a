"""A simulated run: a run directory like that of a live run, from virtual time."""

import secrets
import shutil
from pathlib import Path

from cosim.record.run_directory import (
    EndingFile,
    RunEnding,
    active_run,
    new_run_dir,
    point_to_latest,
    write_environment,
    write_scenario,
)
from cosim.record.run_record import write_run
from cosim.simulation.virtual_time import Progress, simulate_loops
from noack.core.errors import ExitStatus, MachineError, why
from noack.core.process_limits import require_limits
from noack.runtime.life_cycle import HORIZON
from noack.scenario.resolution import resolve_run
from noack.scenario.scenario import Scenario


def simulate_run(scenario: Scenario, runs: Path, progress: Progress | None = None) -> RunEnding:
    """Simulate a scenario into a new run directory; :func:`cosim.live.finalize.finalize` ends it.

    An interrupted simulation leaves no run directory.

    Args:
        scenario: as loaded; it is resolved here.
        runs: where run directories are made.
        progress: called with the simulated time.

    Raises:
        CallerError: the scenario's numbers are too large.
        MachineError: the run directory cannot be written, or a limit of the system is too low.
    """
    require_limits()
    resolved = resolve_run(scenario)
    run_dir = new_run_dir(runs, scenario.name)
    run_id = secrets.randbits(64)  # identifies the recording in the viewer
    try:
        with active_run(run_dir), EndingFile(run_dir) as ending:
            write_environment(run_dir, "simulated")
            simulated = simulate_loops(write_scenario(resolved, run_dir), progress)
            write_run(simulated, run_dir)
            ending.store(ExitStatus.OK, HORIZON)
    except BaseException as error:
        shutil.rmtree(run_dir, ignore_errors=True)
        if isinstance(error, OSError):
            raise MachineError(f"{run_dir}: cannot be written: {why(error)}") from None
        raise
    point_to_latest(run_dir)
    return RunEnding(run_dir, run_id, ExitStatus.OK, HORIZON)
