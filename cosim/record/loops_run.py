"""A run of several loops: the record of each loop, and that of the network that they share.

``RUN/record`` has the tables of the network, for all loops and in the time of the run.
``RUN/loops/NAME`` is a run directory of one loop, with the network's rows of this loop.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.record.environment import write_environment
from cosim.record.run_directory import LOOP_FILE, LOOPS, REPORTS_FILE, write_scenario
from cosim.record.run_record import RunRecord, write_record
from noack.config.loops import loops_of, phases_ns
from noack.config.scenario import Scenario
from noack.core.file_access import write_whole


@dataclass(frozen=True)
class LoopsRun:
    """The records of a run of several loops."""

    network: RunRecord
    """The network's tables; its scenario has [[loops]]."""
    loops: Sequence[RunRecord]


def loop_directories(run_dir: Path, scenario: Scenario) -> list[Path]:
    """Return the run directories of the loops, in the order of their numbers."""
    return [run_dir / LOOPS / loop.name for loop in loops_of(scenario)]


def write_loop(record: RunRecord, run_dir: Path, phase_ns: int) -> None:
    """Write the run directory of a loop, without summary.

    Raises:
        OSError, NoackError: it cannot be written.
    """
    (run_dir / "logs").mkdir(parents=True, exist_ok=True)
    write_scenario(record.scenario, run_dir)
    write_environment(run_dir, record.kind)
    place = {"number": record.number, "phase_ns": phase_ns}
    for name, content in ((LOOP_FILE, place), (REPORTS_FILE, record.reports)):
        write_whole(run_dir / name, json.dumps(content, indent=2), make_folder=False)
    write_record(record, run_dir)


def write_loops(run: LoopsRun, run_dir: Path) -> None:
    """Write the records of a run of several loops into its directory, which has its scenario.

    Raises:
        OSError, NoackError: they cannot be written.
    """
    scenario = run.network.scenario
    reports = json.dumps(run.network.reports, indent=2)
    write_whole(run_dir / REPORTS_FILE, reports, make_folder=False)
    write_record(run.network, run_dir)
    directories = loop_directories(run_dir, scenario)
    for record, directory, phase_ns in zip(
        run.loops, directories, phases_ns(scenario), strict=True
    ):
        write_loop(record, directory, phase_ns)
