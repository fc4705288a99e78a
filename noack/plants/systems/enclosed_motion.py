"""A plant's equations, enclosed over a region: by a matrix of intervals, A x + B u.

:mod:`noack_check.equations` has the argument, which the checker's proofs use, too.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from flint import arb, arb_mat

from noack.core.linear_systems import Matrix, Vector
from noack.plants.plant_settings import PlantSystem
from noack.plants.systems.traced_equations import NotEnclosedError, trace
from noack_check.equations import LinearPlants

_AT_REST = 1e-9
"""The plant rests if |f(0, 0)| is at most this share of the largest entry of A and B in its row."""


class Inclusion(NamedTuple):
    """f(x, u) = A x + B u with some A and B of this box, for every x and u of the region."""

    A: Matrix  # centre, (n, n)
    B: Matrix  # (n, m)
    halfwidth_A: Matrix
    halfwidth_B: Matrix


@dataclass(frozen=True)
class EnclosedMotion:
    """The equations of a plant at x = 0, with n states and m inputs, and their enclosures.

    Raises:
        NotEnclosedError: it has no equations that can be enclosed.
    """

    system: PlantSystem
    n: int
    m: int

    def over(self, halfwidths: Vector) -> Inclusion:
        """Enclose the equations over the region |(x, u)_j| ≤ ``halfwidths``, (n + m,).

        Raises:
            NotEnclosedError: there is no enclosure, or the plant does not rest at x = 0, u = 0.
        """
        plants = self._plants(halfwidths)
        A, more_A = _box(plants.A, plants.half_A)
        B, more_B = _box(plants.B, plants.half_B)
        left = _rest(plants)
        if (left > _AT_REST * np.abs(np.hstack([A, B])).max(axis=1)).any():
            raise NotEnclosedError(
                f"it does not rest at x = 0, u = 0: an entry of ẋ is {left.max():.3g} there"
            )
        return Inclusion(A, B, more_A, more_B)

    def linear(self) -> tuple[Matrix, Matrix] | None:
        """Return A and B if all derivatives are the same for all x and u, to rounding.

        None: they are not, or the plant does not rest at x = 0, u = 0.

        Raises:
            NotEnclosedError: there is no enclosure.
        """
        plants = self._plants(np.full(self.n + self.m, np.inf))
        if any(entry != 0 for M in (plants.half_A, plants.half_B, plants.pushes) for entry in M.entries()):
            return None
        return _box(plants.A, plants.half_A)[0], _box(plants.B, plants.half_B)[0]

    @cached_property
    def at_rest(self) -> Vector:
        """Bounds of the entries of |f(0, 0)|, (n,): 0, or what rounding leaves.

        Raises:
            NotEnclosedError: there is no enclosure.
        """
        return _rest(self._plants(np.zeros(self.n + self.m)))

    def _plants(self, halfwidths: Vector) -> LinearPlants:
        return trace(self.system, self.n, self.m, halfwidths, signals=False).plants


def _rest(plants: LinearPlants) -> Vector:
    """Return bounds of the part of ẋ that depends on neither x nor u, (n,)."""
    entries = [_above(entry) if entry != 0 else 0.0 for entry in plants.pushes.entries()]
    return np.asarray(np.array(entries).reshape(plants.pushes.nrows(), -1).sum(axis=1))


def _box(middle: arb_mat, half: arb_mat) -> tuple[Matrix, Matrix]:
    """Return the centre of a matrix of intervals, and half-widths that also cover its rounding."""
    shape = middle.nrows(), middle.ncols()
    pairs = [(float(m.mid()), m, h) for m, h in zip(middle.entries(), half.entries(), strict=True)]
    halves = [0.0 if m == c and h == 0 else _above(abs(m - c) + abs(h)) for c, m, h in pairs]
    return np.array([c for c, _, _ in pairs]).reshape(shape), np.array(halves).reshape(shape)


def _above(value: arb) -> float:
    return math.nextafter(float(value.abs_upper()), math.inf)
