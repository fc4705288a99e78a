"""Which scenarios the computed certificates cover, and exact simulation.

``keys.toml`` beside this file says of every key whether it is used, irrelevant or refused. A key that
is not in it is refused. The statements of witnesses have a table of their own, in the checker.
"""

from functools import cache
from pathlib import Path
from typing import Literal

from noack.core.cached_method import cached_method
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.scenario.scenario import Scenario
from noack_check.keys import KeyTable

NOT_COVERED = "; no certificate covers this"
"""End of the message about a setting that no certificate covers."""
Statement = Literal["linear", "whole run", "exact"]
"""Statements that refuse more keys than others; ``keys.toml`` explains them."""


@cache
def key_table() -> KeyTable:
    """Return the table of keys."""
    return KeyTable(Path(__file__).with_name("keys.toml"))


@cached_method
def refusals(scenario: Scenario, *of: Statement) -> tuple[str, ...]:
    """Return a line for each key of a scenario that no certificate covers; it begins with the key.

    Without ``of`` it is about all certificates, those of a plant on a region, too.
    """
    lines = [line for _, line in key_table().refusals(scenario.content(), of)]
    others = (_unbounded_age(scenario), _load_of_equations(scenario))
    return (*lines, *(line for line in others if line is not None))


def refusal(scenario: Scenario, *of: Statement) -> str | None:
    """Return the first line of :func:`refusals`; None if all keys are covered."""
    return next(iter(refusals(scenario, *of)), None)


def require_certifiable(scenario: Scenario, *of: Statement) -> None:
    """Raise CallerError if no certificate covers a scenario."""
    if (reason := refusal(scenario, *of)) is not None:
        raise CallerError(f"{reason}{NOT_COVERED}")


def require_exact(scenario: Scenario) -> None:
    """Raise CallerError if exact simulation does not cover a scenario."""
    if (reason := refusal(scenario, "exact")) is not None:
        raise CallerError(
            f"{reason}; this needs a linear plant with u = K x_c and a trigger rule of noack, without "
            "acknowledgements, lost actuations, disturbances, noise and observer"
        )


def _load_of_equations(scenario: Scenario) -> str | None:
    """Return why a plant that is not linear by its settings has none with a load."""
    if not scenario.model.load_states or scenario.coverage.is_linear:
        return None
    kind = scenario.plant.system.kind
    return f'model.load: with plant.system.kind = "{kind}" no bound is computed, and none is proven'


def without_loads(resolved: Scenario) -> Scenario:
    """Return a scenario without its loads: no bound is computed with them, but one may be proven."""
    return resolved.model_copy(update={"model": resolved.model.model_copy(update={"load_states": 0})})


def _unbounded_age(scenario: Scenario) -> str | None:
    """Return why the applied input has no largest age, or the watchdog replaces it.

    This concerns actuations over the network.
    """
    timing, policy = scenario.timing, scenario.plant.watchdog.policy
    if (gap_ns := timing.actuation_gap_ns) is None:
        return "network.actuation: without mansd or constraints, the age of the applied input has no bound"
    oldest_ns = timing.controller_period_ns + gap_ns
    if gap_ns and policy != "hold" and timing.actuation_timeout_ns < oldest_ns:
        return (
            f'plant.watchdog.policy = "{policy}": it replaces the input after '
            f"{timing.actuation_timeout_ns / NS_PER_S:g} s, and an actuation may be "
            f"{oldest_ns / NS_PER_S:g} s old; use more controller.predictions, or a longer "
            "plant.watchdog.timeout_s"
        )
    return None
