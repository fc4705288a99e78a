"""How much of a proven bound a simulated run uses."""

import numpy as np
from numpy.typing import NDArray

from noack.theory.certificates.proven_bounds import ProvenBounds

Reals = NDArray[np.float64]


def share_of_bound(bounds: ProvenBounds, output: str, t_ns: NDArray[np.int64], rows: Reals) -> float:
    """Return the largest share of an output's bound that its rows, (N,) or (N, n), reach."""
    sizes = np.linalg.norm(rows.reshape(len(rows), -1), axis=1)
    return float((sizes / bounds.at(output, t_ns * 1e-9)).max())
