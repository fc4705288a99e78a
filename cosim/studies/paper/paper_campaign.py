"""The draws of the page: the variations of the campaign ``paper``, simulated with both loops.

All random streams of draw i have the seed i, so ``noack simulate --set seeds...`` repeats it. MB-ET
and ZOH-ET have the same plant, the same initial state and the same stream of losses.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np

from cosim.shipped_files import find_shipped
from cosim.studies.campaign.campaign_file import Campaign, load
from cosim.studies.campaign.campaign_grid import grid
from cosim.studies.campaign.campaign_run import Progress
from cosim.studies.campaign.campaign_workers import Chunk, Runner
from cosim.studies.paper.draw_measures import (
    MODES,
    Certified,
    Draw,
    Measures,
    Printed,
    certified,
    measure_draw,
    printed,
)
from noack.config.scenario import Scenario
from noack.core.linear_systems import Matrix

BASE, EXACT_MODEL, WIDE_BOX = "base: Bernoulli 0.8", "box × 0: exact model", "box × 5"
OTHER_EXAMPLES = ("nothing lost", WIDE_BOX, EXACT_MODEL)
"""Variations that change the paper's example. The others vary only unspecified settings."""

Table = Literal["printed", "certified", "draws"]

_CHUNK = 10
_VARIED, _PRINTED = 10, 40
"""A variation has one draw per 10 draws of the base. Table ``printed``, the slowest, has one per
40."""
_COMMON = tuple(name for name in Draw._fields if name not in MODES)


def _both_loops(scenario: Scenario, draw: int) -> tuple[float, ...]:
    found = measure_draw(scenario, draw)
    return (*(getattr(found, name) for name in _COMMON), *found.model, *found.zoh)


_ROWS: Mapping[Table, Callable[[Scenario, int], tuple[float, ...]]] = {
    "printed": printed, "certified": certified, "draws": _both_loops
}  # fmt: skip
COLUMNS: Mapping[str, tuple[str, ...]] = {
    "printed": Printed._fields,
    "certified": Certified._fields,
    "draws": (*_COMMON, *(f"{mode}.{name}" for mode in MODES for name in Measures._fields)),
}
"""The columns of each table."""


class EnsemblePart(NamedTuple):
    """A table of a variation, one row per draw, from draw 0 on."""

    table: Table
    variation: str
    draws: int


@dataclass(frozen=True)
class PaperWork:
    """Computes rows of a table for a variation."""

    table: Table
    scenario: Scenario

    def run(self, draws: range) -> Matrix:
        """Compute the rows of the given draws, (draws, columns)."""
        return np.array([_ROWS[self.table](self.scenario, draw) for draw in draws])


@cache
def load_campaign() -> tuple[Campaign, Mapping[str, Scenario]]:
    """Return the shipped campaign ``paper``, and the scenario of each of its variations."""
    path = find_shipped("paper", "campaigns")
    campaign = load(path)
    points = grid(campaign, path)
    return campaign, {point.labels["variation"]: point.scenario for point in points}


def settings_of(draw: int) -> list[str]:
    """Return the settings of a draw of the base, as after ``--set`` on the command line."""
    settings = [f"{key}={json.dumps(value)}" for key, value in load_campaign()[0].settings.items()]
    return [*settings, *(f"seeds.{name}={draw}" for name in ("plant", "initial_state", "loss"))]


def parts(draws: int, variations: tuple[str, ...]) -> list[EnsemblePart]:
    """Return the tables to compute for a base ensemble of this number of draws."""
    varied, few = max(draws // _VARIED, 1), max(draws // _PRINTED, 1)
    return [
        EnsemblePart("printed", BASE, few),
        EnsemblePart("certified", BASE, draws),
        *(EnsemblePart("draws", name, draws if name == BASE else varied) for name in variations),
    ]


def run_parts(
    draws: int, runner: Runner, progress: Progress | None = None
) -> list[tuple[EnsemblePart, Matrix]]:
    """Compute every table for a base ensemble of this number of draws."""
    scenarios = load_campaign()[1]
    wanted = parts(draws, tuple(scenarios))
    works = [PaperWork(part.table, scenarios[part.variation]) for part in wanted]
    chunks = [
        Chunk(i, start, min(start + _CHUNK, part.draws))
        for i, part in enumerate(wanted)
        for start in range(0, part.draws, _CHUNK)
    ]
    found: dict[Chunk, Matrix] = {}
    done, total = 0, sum(part.draws for part in wanted)
    for chunk, rows in runner(works, chunks):
        found[chunk] = rows
        done += len(chunk.draws)
        if progress is not None:
            progress(done, total)
    return [
        (part, np.concatenate([found[chunk] for chunk in chunks if chunk.point == i]))
        for i, part in enumerate(wanted)
    ]
