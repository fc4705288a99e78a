"""A simulated run: a run directory like that of a live run, from virtual time."""

import json
import secrets
import shutil
from collections.abc import Callable
from pathlib import Path

from cosim.record.environment import write_environment
from cosim.record.loops_run import write_loops
from cosim.record.run_directory import (
    REPORTS_FILE,
    active_run,
    new_run_dir,
    point_to_latest,
    write_scenario,
)
from cosim.record.run_ending import EndingFile, RunEnding
from cosim.record.run_record import RunRecord, write_record
from cosim.simulation.virtual_time import Progress, simulate, simulate_loops
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.core.errors import ExitStatus, MachineError, why
from noack.core.file_access import write_whole
from noack.core.process_limits import require_limits
from noack.runtime.life_cycle import HORIZON


def simulate_run(
    scenario: Scenario,
    runs: Path,
    simulator: Callable[..., RunRecord] = simulate,
    progress: Progress | None = None,
    *,
    view: bool = True,
) -> RunEnding:
    """Simulate a scenario into a new run directory; :func:`cosim.live.finalize.finalize` ends it.

    An interrupted simulation leaves no run directory.

    Args:
        scenario: as loaded; it is resolved here.
        runs: where run directories are made.
        simulator: makes the record from the resolved scenario and ``progress``.
        progress: called with the simulated time.
        view: whether to write the recording for the viewer.

    Raises:
        CallerError: the scenario's numbers are too large.
        MachineError: the run directory cannot be written, or a limit of the system is too low.
    """
    require_limits()
    if scenario.loops is not None:
        return _into_new_run(
            scenario, runs, lambda run_dir, _: _write_loops(scenario, run_dir, progress)
        )
    resolved = resolve(scenario)

    def write(run_dir: Path, run_id: int) -> None:
        record = simulator(write_scenario(resolved, run_dir), progress=progress)
        reports = json.dumps(record.reports, indent=2)
        write_whole(run_dir / REPORTS_FILE, reports, make_folder=False)
        write_record(record, run_dir)
        if view:
            from cosim.output.viewer.run_view import write_view  # imports rerun

            write_view(record, run_dir, run_id)

    return _into_new_run(resolved, runs, write)


def _write_loops(scenario: Scenario, run_dir: Path, progress: Progress | None) -> None:
    """Simulate several loops; write their records and that of their network."""
    write_loops(simulate_loops(write_scenario(scenario, run_dir), progress), run_dir)


def _into_new_run(scenario: Scenario, runs: Path, write: Callable[[Path, int], None]) -> RunEnding:
    """Let ``write`` fill a new run directory; remove the directory if it is interrupted."""
    run_dir = new_run_dir(runs, scenario.name)
    run_id = secrets.randbits(64)  # identifies the recording in the viewer
    try:
        with active_run(run_dir), EndingFile(run_dir) as ending:
            write_environment(run_dir, "simulated")
            write(run_dir, run_id)
            ending.store(ExitStatus.OK, HORIZON)
    except BaseException as error:
        shutil.rmtree(run_dir, ignore_errors=True)
        if isinstance(error, OSError):
            raise MachineError(f"{run_dir}: cannot be written: {why(error)}") from None
        raise
    point_to_latest(run_dir)
    return RunEnding(run_dir, run_id, ExitStatus.OK, HORIZON)
