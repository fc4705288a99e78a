"""The shipped scenarios, with settings as on the command line."""

from cosim.shipped_files import find_shipped
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load


def shipped(name: str, *settings: str) -> Scenario:
    """Return a shipped scenario with settings."""
    return load(find_shipped(name, "scenarios"), settings)


def resolved(name: str, *settings: str) -> Scenario:
    """Return the same, resolved."""
    return resolve(shipped(name, *settings))
