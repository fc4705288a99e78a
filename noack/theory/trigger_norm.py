"""A norm for the trigger, W of ‖W e‖, that counts errors by what they do to the input."""

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from noack.core.linear_systems import Matrix, spectral_abscissa
from noack.theory.response_bounds import NotDecayingError

_LEAST = 1e-6
"""Weight of directions that K does not see, as a share."""


def input_norm(H: Matrix, K: Matrix, rate_per_s: float) -> Matrix:
    """Return W, upper triangular, (n, n), with ‖W e‖² = ∫ ‖K e^{(H+r)t} e‖² dt, nearly, and |det W| = 1.

    So ‖W e‖ falls along the models at least like e^{−rt}, and ‖W e‖ ≤ β has the volume of ‖e‖ ≤ β.

    >>> import numpy as np
    >>> input_norm(np.diag([-1.0, -3.0]), np.array([[2.0, 0.0]]), 0.5).shape
    (2, 2)

    Raises:
        NotDecayingError: H + r does not decay.
    """
    n = len(H)
    G, seen = H + rate_per_s * np.eye(n), K.T @ K
    if spectral_abscissa(G) >= 0:
        raise NotDecayingError(f"the models do not decay at {rate_per_s:.3g}/s")
    P = solve_continuous_lyapunov(G.T, -(seen + _LEAST * (np.trace(seen) or 1.0) * np.eye(n)))
    try:
        W = np.linalg.cholesky((P + P.T) / 2).T
    except np.linalg.LinAlgError:
        raise NotDecayingError("the norm is not defined up to rounding") from None
    _, logarithm = np.linalg.slogdet(W)
    return np.asarray(W * np.exp(-logarithm / n))
