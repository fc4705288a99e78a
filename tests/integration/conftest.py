"""Live runs, processes and emulators in the background, as fixtures; each complete run is explained."""

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from cosim.record.run_record import load_run
from tests.helpers.emulators import Emulate, start_emulators
from tests.helpers.live_runs import Running, start_commands, start_runs
from tests.oracles.explained_run.explain import explains
from tests.oracles.explained_run.findings import SCHEDULE

EXPLAINED = set[Path]()
"""The runs of this session that were compared with the model."""


@pytest.fixture(autouse=True)
def complete_runs_are_those_of_the_model(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[None]:
    """Compare each complete record that a live test, or its module, leaves with the model of its scenario.

    A late machine exceeds the times of the schedule in a live run: these are not compared. Nor are runs that
    report datagrams that something else than the emulator lost.
    """
    yield
    if request.node.get_closest_marker("live") is None:
        return
    for path in sorted({*tmp_path_factory.getbasetemp().rglob("summary.json")} - EXPLAINED):
        EXPLAINED.add(path)
        loops = json.loads(path.read_text()).get("loops", [])
        if not loops:  # of a campaign
            continue
        if not all(loop["replay"] and loop["replay"]["complete"] for loop in loops):
            continue
        if any(loop["unintended_losses"] for loop in loops):
            continue
        for record in load_run(path.parent).loops:
            findings = explains(record)
            if record.kind == "live":
                findings = [finding for finding in findings if finding.part != SCHEDULE]
            assert not findings, "\n".join([str(path.parent), *map(str, findings[:5])])


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., Running]]:
    """Start ``noack run`` in the background; kill remaining processes at the end."""
    with start_runs(tmp_path) as begin:
        yield begin


@pytest.fixture
def by_hand(tmp_path: Path) -> Iterator[Callable[[str], subprocess.Popen[str]]]:
    """Start one process by hand; kill remaining processes at the end."""
    with start_commands() as start:
        yield lambda role: start(role, "--json", runtime=tmp_path)


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Emulate]:
    """Start emulators; kill the remaining ones at the end."""
    with start_emulators(tmp_path) as start:
        yield start
