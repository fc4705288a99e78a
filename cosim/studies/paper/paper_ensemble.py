"""Simulates all draws of all conditions, on several cores."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from cosim.studies.paper.draw_measures import Draw, Measures, measure_draw
from cosim.studies.paper.paper_bounds_of_draws import Certified, Printed, certified, printed
from cosim.studies.paper.paper_conditions import BASE, CONDITIONS, Condition, load_condition
from cosim.studies.process_pool import interrupts_held, processes
from noack.config.scenario import Scenario

Row = tuple[float, ...]
Progress = Callable[[int, int], None]
"""Told how many draws are done, and of how many."""

_CHUNK = 10
_FEWEST = 1
_VARIED, _PRINTED = 10, 40
"""Of so many draws of the base, one is taken for each variation, and one for what takes longest."""

_COMMON = tuple(name for name in Draw._fields if name not in ("model", "zoh"))


def _both(scenario: Scenario, draw: int) -> Row:
    found = measure_draw(scenario, draw)
    return tuple(getattr(found, name) for name in _COMMON) + found.model + found.zoh


_TABLES: Mapping[str, tuple[Callable[[Scenario, int], Row], tuple[str, ...]]] = {
    "draws": (
        _both,
        (*_COMMON, *(f"{mode}.{name}" for mode in ("model", "zoh") for name in Measures._fields)),
    ),
    "certified": (certified, Certified._fields),
    "printed": (printed, Printed._fields),
}

COLUMNS: Mapping[str, tuple[str, ...]] = {name: columns for name, (_, columns) in _TABLES.items()}
"""Of each table."""


class EnsemblePart(NamedTuple):
    """A table of a condition, one row per draw, from draw 0 on."""

    table: str
    condition: Condition
    draws: int


def parts(draws: int) -> list[EnsemblePart]:
    """What is to be simulated for an ensemble of so many draws."""
    varied, few = max(draws // _VARIED, _FEWEST), max(draws // _PRINTED, _FEWEST)
    return [
        EnsemblePart("printed", BASE, few),
        EnsemblePart("certified", BASE, draws),
        *(EnsemblePart("draws", c, draws if c is BASE else varied) for c in CONDITIONS),
    ]


def rows_of(path: Path, part: EnsemblePart, draws: Sequence[int]) -> list[Row]:
    """The rows of some draws.

    Raises:
        CallerError: the scenario file is wrong.
    """
    scenario, (row, _) = load_condition(path, part.condition), _TABLES[part.table]
    return [tuple(row(scenario, draw)) for draw in draws]


def simulate_ensemble(
    path: Path, draws: int, workers: int = 1, progress: Progress | None = None
) -> list[tuple[EnsemblePart, list[Row]]]:
    """Simulate every part.

    Args:
        path: the paper's scenario.
        draws: of the base ensemble.
        workers: processes; with 1, none is started.
        progress: is told how far the work is.
    """
    wanted = parts(draws)
    tasks = [
        (path, part, range(start, min(start + _CHUNK, part.draws)))
        for part in wanted
        for start in range(0, part.draws, _CHUNK)
    ]
    found: dict[EnsemblePart, list[Row]] = {part: [] for part in wanted}
    done, total = 0, sum(part.draws for part in wanted)
    for (_, part, chunk), rows in zip(tasks, _work(tasks, workers), strict=True):
        found[part] += rows
        done += len(chunk)
        if progress is not None:
            progress(done, total)
    return list(found.items())


_Task = tuple[Path, EnsemblePart, range]


def _work(tasks: Sequence[_Task], workers: int) -> Iterator[list[Row]]:
    if workers == 1:
        yield from (rows_of(*task) for task in tasks)
        return
    with processes(workers) as pool:
        with interrupts_held():
            rows = pool.map(_rows_of, tasks)
        yield from rows


def _rows_of(task: _Task) -> list[Row]:
    return rows_of(*task)
