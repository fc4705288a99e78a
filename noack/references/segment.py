"""A segment of a resolved reference: x_r(t) and u_r(t) of all states and inputs."""

from typing import Literal

import numpy as np

from netem.core.clock import NS_PER_S
from noack.core.references import ReferenceSegment
from noack.references.piece_settings import PieceSettings, TimeS
from noack.settings.values import MatrixRows, Row, rows_of


class SolutionSegment(PieceSettings):
    """x_r = Σ_k x_k τ^k + Σ_l x_sines_l sin 2πf_l τ + x_cosines_l cos 2πf_l τ, and u_r likewise.

    A resolved scenario has these in place of other pieces; τ is the time since the segment's begin.
    """

    kind: Literal["segment"]
    from_s: TimeS
    """When it begins; it ends where the next one begins. The first one begins at 0."""
    x: MatrixRows
    """Coefficients of 1, τ, τ² … of the states, by rows."""
    u: MatrixRows
    """The same of the inputs."""
    hz: Row | None = None
    """Frequencies f of sine waves."""
    x_sines: MatrixRows | None = None
    """Factors of their sines in the states, a row per frequency."""
    x_cosines: MatrixRows | None = None
    """Factors of their cosines."""
    u_sines: MatrixRows | None = None
    """Factors of their sines in the inputs."""
    u_cosines: MatrixRows | None = None
    """Factors of their cosines."""

    @classmethod
    def of(cls, segment: ReferenceSegment, n: int) -> "SolutionSegment":
        """Return the settings of a segment of n states."""
        waves = {"x_sines": segment.sines[:, :n], "x_cosines": segment.cosines[:, :n]}
        waves |= {"u_sines": segment.sines[:, n:], "u_cosines": segment.cosines[:, n:]}
        return cls.model_validate(
            {
                "kind": "segment",
                "from_s": segment.begin_ns / NS_PER_S,
                "x": rows_of(segment.polynomial[:, :n]),
                "u": rows_of(segment.polynomial[:, n:]),
            }
            | ({"hz": tuple(segment.hz.tolist())} if len(segment.hz) else {})
            | ({name: rows_of(rows) for name, rows in waves.items()} if len(segment.hz) else {})
        )

    @property
    def begin_ns(self) -> int:
        """When it begins."""
        return round(self.from_s * NS_PER_S)

    @property
    def numbers(self) -> ReferenceSegment:
        """The numbers as arrays."""
        polynomial = np.hstack([self.x, self.u])
        if self.hz is None:
            nothing = np.zeros((0, polynomial.shape[1]))
            return ReferenceSegment(self.begin_ns, polynomial, np.zeros(0), nothing, nothing)
        sines = np.hstack([self.x_sines or (), self.u_sines or ()])
        cosines = np.hstack([self.x_cosines or (), self.u_cosines or ()])
        return ReferenceSegment(self.begin_ns, polynomial, np.array(self.hz), sines, cosines)

    def check(self, n: int, m: int) -> None:
        """Raise ValueError unless the numbers are those of n states and m inputs."""
        waves = 0 if self.hz is None else len(self.hz)
        for name, width in (("x", n), ("u", m)):
            heights = {name: len(self.x), f"{name}_sines": waves, f"{name}_cosines": waves}
            for key, height in heights.items():
                found = getattr(self, key) or ()
                if len(found) != height or any(len(row) != width for row in found):
                    raise ValueError(f"{key}: expected {height} rows of {width} numbers")
