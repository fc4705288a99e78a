"""The draws of a campaign: plants from the box, initial states, losses, disturbances and noise.

Each quantity has its own random stream. Draw i depends only on the campaign's seed and on i, and
not on the grid point, the chunk or the worker.
"""

from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.simulation.exact_simulation import Population
from netem.core.random_streams import uniforms, words
from noack.core.linear_systems import Matrix, Vector
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.run_sections import SeedsSection
from noack.scenario.scenario import Scenario

_STREAM = "campaign"


class Box(NamedTuple):
    """The box of plants and initial states."""

    A: Matrix
    """Centre of A, (n, n)."""
    B: Matrix
    """Centre of B, (n, m)."""
    x0: Vector
    """Centre of x(0), (n,)."""
    half_A: Matrix
    """Half-widths of A, (n, n)."""
    half_B: Matrix
    """Half-widths of B, (n, m)."""
    half_x0: Vector
    """Half-widths of x(0), (n,)."""
    vertex: bool
    """Whether plants are drawn from the corners of the box only."""

    def population(self, seed: int, draws: range) -> Population:
        """Return consecutive draws."""
        signs = partial(np.copysign, 1.0) if self.vertex else np.asarray
        A, B = (
            centre + half * signs(_units(seed, name, draws, centre.size)).reshape(-1, *centre.shape)
            for name, centre, half in (("A", self.A, self.half_A), ("B", self.B, self.half_B))
        )
        x0 = self.x0 + self.half_x0 * _units(seed, "initial_state", draws, self.x0.size)
        return Population(A, B, x0, _seeds(seed, "loss", draws))


def box_of(scenario: Scenario) -> Box:
    """Return the box of a scenario; a given or nominal plant has a box of width 0.

    The box of a nonlinear plant is around the model.
    """
    plant = scenario.plant
    draw = "given" if plant.draw == "given" else "nominal"
    centre = plant.model_copy(update={"draw": draw, "initial_state_halfwidth": None})
    loop = loop_of(resolve(scenario.model_copy(update={"plant": centre})))
    drawn = plant.draw in ("uniform", "vertex")

    def half(halfwidth: tuple[object, ...] | None, centre_value: Matrix) -> Matrix:
        return np.zeros_like(centre_value) if halfwidth is None else np.array(halfwidth, dtype=np.float64)

    return Box(
        loop.A,
        loop.B,
        loop.x0,
        half(plant.uncertainty_A if drawn else None, loop.A),
        half(plant.uncertainty_B if drawn else None, loop.B),
        half(plant.initial_state_halfwidth, loop.x0),
        plant.draw == "vertex",
    )


def drawn_scenario(scenario: Scenario, seed: int, draw: int) -> Scenario:
    """Return one run of a campaign as a resolved scenario."""
    draws = range(draw, draw + 1)
    A, B, x0, loss_seeds = (quantity[0].tolist() for quantity in box_of(scenario).population(seed, draws))
    update: dict[str, object] = {"initial_state": tuple(x0), "initial_state_halfwidth": None}
    if scenario.coverage.is_linear:
        update |= {"draw": "given", "A": tuple(map(tuple, A)), "B": tuple(map(tuple, B))}
    disturbance, noise = (int(_seeds(seed, name, draws)[0]) for name in ("disturbance", "noise"))
    seeds = SeedsSection(loss=loss_seeds, disturbance=disturbance, noise=noise)
    plant = scenario.plant.model_copy(update=update)
    return resolve(scenario.model_copy(update={"plant": plant, "seeds": seeds}))


def seeds_of(seed: int, draw: int) -> SeedsSection:
    """Return the seeds of a run of several loops, from which the loops draw theirs."""
    draws = range(draw, draw + 1)
    return SeedsSection(**{name: int(_seeds(seed, name, draws)[0]) for name in SeedsSection.model_fields})


def _seeds(seed: int, name: str, draws: range) -> NDArray[np.uint64]:
    """Return seeds of 63 bits, the range of a TOML integer, (k,)."""
    return words(seed, _STREAM, name, rows=draws, width=1)[:, 0] >> np.uint64(1)


def _units(seed: int, name: str, draws: range, width: int) -> Matrix:
    """Return uniform numbers in [−1, 1), (k, width)."""
    return 2.0 * uniforms(seed, _STREAM, name, rows=draws, width=width) - 1.0
