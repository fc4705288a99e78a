"""Scenarios whose plant needs a package that may be missing here."""

from pathlib import Path

import pytest

from noack.core.errors import CallerError
from noack.scenario.scenario_file import load


def skip_without_plant(path: Path) -> None:
    """Skip the test, with the reason, if the plant of a scenario file needs a missing package."""
    try:
        load(path).plant.system.require_installed()
    except CallerError as error:
        pytest.skip(str(error))
