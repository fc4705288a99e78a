"""What is drawn, and under which conditions: the base ensemble and its variations.

A condition is a scenario file and a few settings, as on the command line; draw number i puts i in
the place of all three seeds, whose streams are independent of each other. MB-ET and ZOH-ET get the
same plant, the same initial state and the same stream of losses.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import load
from noack.config.sections.run_sections import SeedsSection

Mode = Literal["model", "zoh"]

MODES: Mapping[Mode, str] = {"model": "MB-ET", "zoh": "ZOH-ET"}
"""How the paper calls them."""

HORIZON_S = 40.0
"""Long enough for every draw to settle."""


class Condition(NamedTuple):
    """A variation of the base ensemble."""

    name: str
    title: str
    settings: tuple[str, ...]
    """As after ``--set``, beyond those of the base."""
    left_open: bool = True
    """Whether it varies only what the paper leaves open: how much is lost, and from where."""


_STREAMS = ("plant", "initial_state", "loss")
_COMMON = (f"horizon_s={HORIZON_S}", "plant.initial_state_halfwidth=[0.5, 0.1, 0.1, 2.0]")


def _box(factor: float) -> tuple[str, ...]:
    a, b = 0.1 * factor, 0.05 * factor
    return (
        f"plant.uncertainty_A=[[{a}, {a}, 0, 0], [{a}, {a}, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]",
        f"plant.uncertainty_B=[[{b}, 0], [0, {b}], [0, 0], [0, 0]]",
    )


def _start(factor: float) -> tuple[str, ...]:
    return (
        f"plant.initial_state=[{0.5 * factor}, 0, {0.1 * factor}, {3 * factor}]",
        "plant.initial_state_halfwidth="
        f"[{0.5 * factor}, {0.1 * factor}, {0.1 * factor}, {2 * factor}]",
    )


BASE = Condition("base", "base: Bernoulli 0.8", ())
CONDITIONS = (
    BASE,
    Condition("lossless", "nothing lost", ('network.loss={model="lossless"}',), left_open=False),
    Condition("loss_0.5", "Bernoulli 0.5", ("network.loss.probability=0.5",)),
    Condition(
        "worst_case", "worst case: every fifth arrives", ('network.loss={model="worst_case"}',)
    ),
    Condition("near", "x(0) × 0.1", _start(0.1)),
    Condition("far", "x(0) × 10", _start(10.0)),
    Condition(
        "any_direction",
        "x(0) in [−3, 3]⁴",
        ("plant.initial_state=[0, 0, 0, 0]", "plant.initial_state_halfwidth=[3, 3, 3, 3]"),
    ),
    Condition("wide_box", "box × 5", _box(5.0), left_open=False),
    Condition("exact_model", "box × 0: exact model", ("plant.draw=nominal",), left_open=False),
)


def load_condition(path: Path, condition: Condition) -> Scenario:
    """The scenario of a condition, seeds not set.

    Raises:
        CallerError: the scenario file is wrong.
    """
    return load(path, (*_COMMON, *condition.settings))


def settings_of(condition: Condition, draw: int) -> list[str]:
    """All settings of a draw, as after ``--set`` on the command line."""
    seeds = [f"seeds.{stream}={draw}" for stream in _STREAMS]
    return [*_COMMON, *condition.settings, *seeds]


def resolved_draw(scenario: Scenario, draw: int, mode: Mode) -> Scenario:
    """Draw number ``draw`` of a condition's scenario, resolved."""
    seeds = SeedsSection(**dict.fromkeys(_STREAMS, draw))
    return resolve(scenario.model_copy(update={"mode": mode, "seeds": seeds}))
