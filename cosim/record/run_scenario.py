"""The scenario of a run, in its directory, with copies of the files that the run executes."""

from pathlib import Path

from cosim.record.run_directory import SCENARIO_FILE
from netem.core.file_access import copy_whole, create_folder, write_whole
from noack.scenario.resolution import ResolvedRun
from noack.scenario.scenario import Scenario, with_loop_tables
from noack.scenario.scenario_file import dumps
from noack.settings.user_files import FileSettings, checked_path, file_tables, with_tables


def write_scenario(run: ResolvedRun, run_dir: Path) -> ResolvedRun:
    """Write the scenario of a run into its directory, with the files that the run executes.

    The copies allow a replay after a file has changed, and the directory can be moved. The file of
    a plant is copied to ``plant/``, that of a trigger to ``trigger/``, and so on. The names of the
    files of an entry of [[loops]] begin with ``loops_0_``, and so on.

    Returns:
        The run, with a scenario for its processes, which use the copies.

    Raises:
        CallerError: a file has changed since the scenario was loaded.
        MachineError, OSError: the directory cannot be written.
    """
    scenario = run.scenario
    common = dict(file_tables(scenario))
    copied = list[str]()

    def copy_files(prefix: str, within_scenario: Scenario, folder: str) -> dict[str, FileSettings]:
        copies = {}
        for key, table in file_tables(within_scenario):
            if prefix and table == common.get(key):
                continue  # the entry does not set it
            file = checked_path(table, f"{prefix}{key}")
            name = f"{key.split('.')[0]}/{prefix.replace('.', '_')}{file.name}"
            if not (run_dir / name).is_file():
                create_folder((run_dir / name).parent)
                copy_whole(file, run_dir / name)
            copied.append(name)
            copies[key] = table.model_copy(update={"file": f"{folder}{name}"})
        return copies

    def scenario_in(folder: str) -> Scenario:
        relocated = with_loop_tables(scenario, lambda entry, loop: copy_files(f"{entry}.", loop, folder))
        return with_tables(relocated, copy_files("", scenario, folder))

    write_whole(run_dir / SCENARIO_FILE, dumps(scenario_in("")))
    return ResolvedRun(scenario_in(f"{run_dir.absolute()}/")) if copied else run
