"""Live runs and processes, started in the background, as fixtures."""

import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.helpers.live_runs import Running, start_commands, start_runs


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
