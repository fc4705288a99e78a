"""A published result, beside what noack computes for it: its rows, its tables, its document.

At the end are exact runs of shipped scenarios, from which several results are reproduced.
"""

import math
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from cosim.output.result_tables import ResultTable, terminal_table
from cosim.shipped_files import find_shipped
from cosim.simulation.continuous import ContinuousLoop, continuous_loop_of
from cosim.simulation.exact_simulation import EventLog
from noack.core.errors import MachineError
from noack.core.linear_systems import Matrix
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load

if TYPE_CHECKING:
    from rich.console import Console

_STYLES = {"reproduced": "green", "agrees": "green", "differs": "red"}
"""Of a verdict in the terminal."""


class ComparedValue(NamedTuple):
    """A published value and the computed one."""

    quantity: str
    where: str
    """Where the published value stands."""
    relation: str
    """What the computed value is to be: =, <, ≤, > or ≥ the published one, or among these."""
    published: str
    computed: str
    how: str
    """How the computed value is obtained."""
    agrees: bool
    deviation: str = ""
    """What is known about a value that does not agree."""

    @property
    def verdict(self) -> str:
        """``reproduced`` (a value), ``agrees`` (with a statement, as an inequality), or ``differs``."""
        if not self.agrees:
            return "differs"
        return "reproduced" if self.relation == "=" else "agrees"

    @property
    def as_expected(self) -> bool:
        """Whether the values agree, unless it is known that they do not."""
        return self.agrees is not bool(self.deviation)


class PublishedResult(NamedTuple):
    """A publication's numerical results."""

    about: str
    """What is reproduced, in one line."""
    reference: str
    rows: Callable[[], Sequence[ComparedValue]]
    """Computes the rows."""
    notes: tuple[str, ...] = ()
    """What the publication, as far as it was available, does not give."""


class Reproduction(NamedTuple):
    """A result that has been computed."""

    name: str
    result: PublishedResult
    rows: Sequence[ComparedValue]

    @property
    def as_expected(self) -> bool:
        """Whether each row is."""
        return all(row.as_expected for row in self.rows)

    @property
    def table(self) -> ResultTable:
        """Published against computed."""
        headings = ("quantity", "where", "relation", "published", "computed", "verdict")
        cells = [(*row[:5], row.verdict) for row in self.rows]
        return ResultTable(self.name, self.result.reference, headings, cells)

    def remarks(self) -> list[str]:
        """Return how the rows are computed, known deviations, and what is not given."""
        methods = dict.fromkeys(f"computed: {row.how}" for row in self.rows)
        deviations = (f"{row.quantity}: {row.deviation}" for row in self.rows if row.deviation)
        return [*methods, *deviations, *self.result.notes]

    def to_json(self) -> Mapping[str, object]:
        """Return the document of ``--json``."""
        rows = [row._asdict() | {"verdict": row.verdict} for row in self.rows]
        source = {"about": self.result.about, "reference": self.result.reference}
        return {"name": self.name, **source, "rows": rows, "notes": list(self.result.notes)}


def print_rows(console: "Console", reproduction: Reproduction) -> None:
    """Print published against computed, and what is to be known about it."""
    quantity, where, _, *values = reproduction.table.headings
    narrow = reproduction.table._replace(headings=[quantity, where, "", *values])
    console.print(terminal_table(narrow, left=range(3), styles=_STYLES, dense=True))
    for remark in reproduction.remarks():
        console.print(remark, markup=False, highlight=False)
    verdict = f"{sum(row.agrees for row in reproduction.rows)} of {len(reproduction.rows)} agree"
    console.print(verdict, style="bold" if reproduction.as_expected else "bold red", highlight=False)


def value_row(
    quantity: str, where: str, published: float, computed: float, method: str, *, digits: int
) -> ComparedValue:
    """Return the row of a number that is published with ``digits`` digits after the point."""
    agrees = abs(computed - published) <= 0.5000001 * 10.0**-digits
    texts = f"{published:.{digits}f}", f"{computed:.{digits + 1}f}"
    return ComparedValue(quantity, where, "=", *texts, method, agrees)


def stored_matrices(name: str) -> dict[str, dict[str, Matrix]]:
    """Return the tables of numbers, published or found, beside the result in NAME.toml."""
    path = Path(__file__).parent / "results" / f"{name}.toml"
    tables = tomllib.loads(path.read_text(encoding="utf-8"))
    return {key: {entry: np.array(rows) for entry, rows in table.items()} for key, table in tables.items()}


def shipped_loop(name: str, settings: Iterable[str] = ()) -> ContinuousLoop:
    """Return the exact loop of a shipped scenario, with settings as for ``--set``."""
    return continuous_loop_of(resolve(load(find_shipped(name, "scenarios"), list(settings))))


def unit_states(draws: int, n: int) -> Matrix:
    """Return initial states of length 1: evenly spaced for two states, else random, (draws, n)."""
    if n == 2:
        angles = np.linspace(0.0, math.pi, draws, endpoint=False)
        return np.stack([np.cos(angles), np.sin(angles)], axis=1)
    states = np.random.default_rng(1).normal(size=(draws, n))
    return np.asarray(states / np.linalg.norm(states, axis=1, keepdims=True), np.float64)


def run_from_each(loop: ContinuousLoop, x0: Matrix, horizon_s: float, most_events: int = 2000) -> EventLog:
    """Return the events of a run from each initial state; every update arrives.

    Raise MachineError if a run has more events than ``most_events``.
    """
    k = len(x0)
    A, B = (np.broadcast_to(part, (k, *part.shape)) for part in (loop.loop.A, loop.loop.B))
    simulation = loop.simulation(
        horizon_s, known_start=True, delivered=np.zeros(0, np.bool_), most_events=most_events
    )
    rows, log = simulation.runs(A, B, x0, places=most_events, states=True)
    if rows["status"].any():
        raise MachineError(f"a run did not reach its end within {most_events} events")
    log.event_s[np.arange(most_events) >= rows["transmissions"][:, None]] = np.nan
    return log
