"""The weights of a cost ∫ xᵀQx + uᵀRu dt, as the options --Q and --R give them."""

from json import dumps

import numpy as np

from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import value_of


def cost_weights(scenario: Scenario, Q: str | None, R: str | None) -> tuple[Matrix, Matrix]:
    """Return Q and R; raise CallerError if one is wrong."""
    n, m = scenario.model.dimensions
    return _weight_matrix("--Q", Q, n), _weight_matrix("--R", R, m)


def _weight_matrix(option: str, text: str | None, size: int) -> Matrix:
    """Return the weight that an option gives by rows, or its diagonal; None: the identity."""
    if text is None:
        return np.eye(size)
    try:
        value = np.array(value_of(text, option), dtype=np.float64)
    except (CallerError, ValueError, TypeError):
        value = np.empty(0)
    if value.ndim == 1:
        value = np.diag(value)
    if value.shape != (size, size) or not np.isfinite(value).all():
        example = dumps([1] * size)
        raise CallerError(
            f"{option} {text}: expected {size} x {size} numbers by rows, or {size} for the "
            f"diagonal, e.g. '{example}'"
        )
    return value
