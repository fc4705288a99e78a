"""The shipped scenarios, with settings as on the command line."""

from cosim.shipped_files import find_shipped
from netem.core.toml_file import read
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import completed_with, settings_of


def shipped(name: str, *settings: str) -> Scenario:
    """Return a shipped scenario with settings, of which a later one replaces an earlier one.

    With another model its outputs are the states.
    """
    path = find_shipped(name, "scenarios")
    content = read(path, Scenario)
    given = [pair for setting in settings for pair in settings_of([setting])]
    if "model" in dict(given):
        content.pop("outputs", None)
    return completed_with(content, given, path, "--set ")


def resolved(name: str, *settings: str) -> Scenario:
    """Return the same, resolved."""
    return resolve(shipped(name, *settings))
