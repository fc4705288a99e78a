"""Compares the linearisation of a non-linear plant with the model that its loop uses."""

import numpy as np
from numpy.typing import ArrayLike

from cosim.analysis.summary_model import LinearisationPart, NoLinearisationPart
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.core.errors import NoackError
from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantSystem
from noack.plants.systems.plant_linearisation import linearise
from plant_server.plant import system_of

Linearisation = LinearisationPart | NoLinearisationPart

_EXACT = 1e-3
"""Tolerance for an entry with a half-width of 0, as the linearisation uses finite differences."""


def linearisation(resolved: Scenario) -> Linearisation | None:
    """Return the linearisation of a resolved scenario's plant; None for a linear plant.

    Its fields: ``A`` and ``B`` by rows; ``eigenvalues`` of A + BK as pairs of real and imaginary
    part; ``off_A`` and ``off_B``, A − Â and B − B̂; ``in_box``, whether these are within the
    half-widths of the scenario's uncertainty box, None without a box. If x is not the whole state,
    the only field is ``A``, with the value None.
    """
    if resolved.coverage.is_linear:
        return None
    loop, plant = loop_of(resolved), resolved.plant

    def system_at(x0: Vector) -> PlantSystem:
        started = plant.model_copy(update={"initial_state": tuple(x0.tolist())})
        return system_of(resolved.model_copy(update={"plant": started}))

    n, m = loop.n, loop.m
    try:
        with np.errstate(all="ignore"):
            A, B = plant.system.linearisation() or linearise(
                system_at, n, m, settling_s=plant.system.settling_s
            )
    except NoackError:  # a user's plant: its code fails, or it does not accept this x(0)
        A, B = np.full((n, n), np.nan), np.full((n, m), np.nan)
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        return NoLinearisationPart(A=None)
    off_A, off_B = A - loop.A_model, B - loop.B_model
    poles = np.linalg.eigvals(A + B @ loop.K)
    in_box: bool | None = None
    if plant.uncertainty_A is not None or plant.uncertainty_B is not None:
        in_box = _within(off_A, plant.uncertainty_A) and _within(off_B, plant.uncertainty_B)
    return LinearisationPart(
        A=A.tolist(),
        B=B.tolist(),
        eigenvalues=[[float(pole.real), float(pole.imag)] for pole in poles],
        off_A=off_A.tolist(),
        off_B=off_B.tolist(),
        in_box=in_box,
    )


def _within(off: Matrix, halfwidth: ArrayLike | None) -> bool:
    allowed = np.zeros_like(off) if halfwidth is None else np.array(halfwidth)
    return bool((np.abs(off) <= np.maximum(allowed, _EXACT)).all())


def linearisation_rows(found: Linearisation) -> tuple[tuple[str, str], ...]:
    """Return a linearisation as text: quantities and their values."""
    if isinstance(found, NoLinearisationPart):
        return (("the plant, linearised", "none: x is not its whole state, or it is not smooth"),)
    slowest = max(real for real, _ in found.eigenvalues)
    worst, where = max(
        (abs(entry), f"{name}[{i}, {j}]")
        for name, off in (("A", found.off_A), ("B", found.off_B))
        for i, row in enumerate(off, 1)
        for j, entry in enumerate(row, 1)
    )
    box = {True: ", inside the box", False: ", outside the box", None: ""}[found.in_box]
    return (
        ("the plant, linearised: poles of A + BK", f"up to {slowest:.3g} /s"),
        ("  largest difference to the model", f"{where}, by {worst:.3g}{box}"),
    )
