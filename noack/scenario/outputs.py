"""The outputs of a loop: what bounds, claims and figures are about, in units of their own.

An output is y = c x, a row c of n factors; by default the outputs are the states. With a set-point x_r
its deviation is c (x - x_r).
"""

from collections.abc import Sequence
from typing import NamedTuple

from netem.core.settings_section import Positive, ScenarioSection
from noack.settings.values import Name, Row, Unit, require_length

DISTANCE = "output "
"""What the name of an output's distance begins with."""


class OutputSection(ScenarioSection):
    """An output of the loop: a quantity that its user wants to know."""

    name: Name
    """The output's name."""
    unit: Unit = ""
    """Its unit, e.g. "rad"; by default that of the state, if it is one."""
    row: Row | str | None = None
    """The factors of the states whose sum it is, n entries, or the name of one state. By default the
    state of the output's name."""
    allowed: Positive | None = None
    """The allowed error: how far the output may be from its set-point once the loop has settled.
    ``noack certify`` says from when on it is within; each run checks it."""


class LoopOutput(NamedTuple):
    """An output of a resolved scenario."""

    name: str
    unit: str
    row: tuple[float, ...]
    """The factors of the n states."""
    allowed: float | None = None
    """The allowed error; None: nothing is asked."""

    @property
    def distance(self) -> str:
        """The name of its distance |y − r| from what it follows, in bounds and curves."""
        return f"{DISTANCE}{self.name}"

    def quantity(self, value: str) -> str:
        """Return a value with the output's unit."""
        return f"{value} {self.unit}".rstrip()


def loop_outputs(
    sections: Sequence[OutputSection] | None,
    state_names: Sequence[str],
    state_units: Sequence[str] | None = None,
    further: int = 0,
) -> tuple[LoopOutput, ...]:
    """Return the outputs of a loop, p of them.

    Args:
        sections: those of the scenario; None: the states of the plant.
        state_names: the names of the states.
        state_units: their units, if they are known.
        further: the number of the last states that are not the plant's: loads, or the controller's.

    Raises:
        ValueError: a row does not fit; the message begins with its key.
    """
    n = len(state_names)
    units = state_units or [""] * n
    if sections is None:
        names = zip(state_names[: n - further], units, strict=False)
        return tuple(LoopOutput(name, unit, _unit_row(i, n)) for i, (name, unit) in enumerate(names))
    found = list[LoopOutput]()
    for index, section in enumerate(sections):
        key = f"outputs.{index}"
        if section.name in [output.name for output in found]:
            raise ValueError(f"{key}.name: {section.name} is the name of another output, too")
        row = _row_of(section, f"{key}.row", state_names)
        unit = section.unit or next((units[i] for i in range(n) if row == _unit_row(i, n)), "")
        found.append(LoopOutput(section.name, unit, row, section.allowed))
    return tuple(found)


def _row_of(section: OutputSection, key: str, state_names: Sequence[str]) -> tuple[float, ...]:
    if isinstance(section.row, tuple):
        require_length(section.row, key, len(state_names), "one factor per state")
        if not any(section.row):
            raise ValueError(f"{key}: all factors are 0; the output would not depend on the state")
        return section.row
    state = section.name if section.row is None else section.row
    if state not in state_names:
        known = ", ".join(state_names)
        raise ValueError(f"{key}: no state has the name {state}; the states are {known}; or give the factors")
    return _unit_row(list(state_names).index(state), len(state_names))


def _unit_row(index: int, n: int) -> tuple[float, ...]:
    return tuple(float(i == index) for i in range(n))
