"""The shipped scenarios, with settings as on the command line; some need a package that may be missing."""

from pathlib import Path

import pytest

from cosim.shipped_files import find_shipped
from noack.core.errors import CallerError
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load


def shipped(name: str, *settings: str) -> Scenario:
    """Return a shipped scenario with settings."""
    return load(find_shipped(name, "scenarios"), settings)


def resolved(name: str, *settings: str) -> Scenario:
    """Return the same, resolved."""
    return resolve(shipped(name, *settings))


def skip_without_plant(path: Path) -> None:
    """Skip the test, with the reason, if the plant of a scenario file needs a missing package."""
    try:
        load(path).plant.system.require_installed()
    except CallerError as error:
        pytest.skip(str(error))
