"""Resolved scenarios as the checker reads them."""

import tomllib
from typing import Any

from noack.scenario.resolution import resolved_loops
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps
from noack.theory.certificates.conditions import with_stated_numbers
from tests.helpers.shipped import shipped


def first_loop(name: str, *settings: str) -> Scenario:
    """Return the resolved scenario of a shipped scenario's first loop."""
    return resolved_loops(shipped(name, *settings))[0]


def tables_of(resolved: Scenario) -> dict[str, Any]:
    """Return what ``noack check --resolved`` prints of a resolved scenario, parsed."""
    return tomllib.loads(dumps(with_stated_numbers(resolved)))


def resolved_tables(name: str, *settings: str) -> dict[str, Any]:
    """Return the same of a shipped scenario's first loop."""
    return tables_of(first_loop(name, *settings))
