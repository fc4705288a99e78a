"""Compares the linearisation of a non-linear plant with the loop's model."""

import numpy as np
from numpy.typing import ArrayLike

from cosim.analysis.summary.summary_model import LinearisationPart, NoLinearisationPart
from netem.core.errors import NoackError
from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantStart, PlantSystem
from noack.plants.systems.linearisation import NO_STATE, STEP_NS, linearise
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario

Linearisation = LinearisationPart | NoLinearisationPart
_EXACT = 1e-3
"""Tolerance for an entry with a half-width of 0, as the linearisation uses finite differences."""


def linearisation(resolved: Scenario) -> Linearisation | None:
    """Return the linearisation of a resolved scenario's plant; None for a linear plant.

    Its fields: ``A`` and ``B`` by rows; ``eigenvalues`` of A + BK as pairs of real and imaginary
    part; ``off_A`` and ``off_B``, A − Â and B − B̂; ``in_box``, whether these are within the
    half-widths of the scenario's uncertainty box, None without a box. If x is not the whole state,
    the only field is ``A``, with the value None. A and B are those of the plant's own states; A + BK has
    the controller's states, too, and no loads.
    """
    if resolved.coverage.is_linear:
        return None
    loop, plant = loop_of(resolved).without_loads, resolved.plant
    n, m = resolved.model.plant_states, loop.m
    A_model, B_model = loop.A_model[:n, :n], loop.B_model[:n]

    def system_at(x0: Vector) -> PlantSystem:
        return plant.system.system(PlantStart(x0, A_model, B_model, resolved.timing.plant_period_ns))

    try:
        with np.errstate(all="ignore"):
            if (exact := plant.system.linearisation()) is not None:
                A, B = exact
            else:
                is_fixed = plant.system.has_own_step
                step_ns = resolved.timing.plant_period_ns if is_fixed else STEP_NS
                linearised = linearise(system_at, n, m, step_ns=step_ns)
                A, B = linearised.A, linearised.B
    except NoackError:  # a user's plant: its code fails, or it does not accept this x(0)
        A, B = np.full((n, n), np.nan), np.full((n, m), np.nan)
    if not (np.isfinite(A).all() and np.isfinite(B).all()):
        return NoLinearisationPart(A=None)
    off_A, off_B = A - A_model, B - B_model
    whole = loop.A_model + loop.B_model @ loop.K
    whole[:n] += np.pad(off_A, ((0, 0), (0, loop.n - n))) + off_B @ loop.K
    poles = np.linalg.eigvals(whole)
    in_box: bool | None = None
    if plant.uncertainty_A is not None or plant.uncertainty_B is not None:
        in_box = _is_within(off_A, plant.uncertainty_A) and _is_within(off_B, plant.uncertainty_B)
    return LinearisationPart(
        A=A.tolist(),
        B=B.tolist(),
        eigenvalues=[[float(pole.real), float(pole.imag)] for pole in poles],
        off_A=off_A.tolist(),
        off_B=off_B.tolist(),
        in_box=in_box,
    )


def _is_within(off: Matrix, halfwidth: ArrayLike | None) -> bool:
    """Whether entries are within half-widths, of which further rows and columns are those of other states."""
    rows, columns = off.shape
    allowed = np.zeros_like(off) if halfwidth is None else np.array(halfwidth)[:rows, :columns]
    return bool((np.abs(off) <= np.maximum(allowed, _EXACT)).all())


def linearisation_rows(linearised: Linearisation) -> tuple[tuple[str, str], ...]:
    """Return a linearisation as text: quantities and their values."""
    if isinstance(linearised, NoLinearisationPart):
        return (("the plant, linearised", f"none: {NO_STATE}, or it is another program"),)
    slowest = max(real for real, _ in linearised.eigenvalues)
    worst, where = max(
        (abs(entry), f"{name}[{i}, {j}]")
        for name, off in (("A", linearised.off_A), ("B", linearised.off_B))
        for i, row in enumerate(off, 1)
        for j, entry in enumerate(row, 1)
    )
    box = {True: ", inside the box", False: ", outside the box", None: ""}[linearised.in_box]
    return (
        ("the plant, linearised: poles of A + BK", f"up to {slowest:.3g} /s"),
        ("  largest difference to the model", f"{where}, by {worst:.3g}{box}"),
    )
