"""The disturbances of a scenario's plant: any number, each of any kind."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from noack.core.linear_systems import Vector
from noack.disturbances.disturbance_settings import DisturbanceSettings, Place
from noack.settings.matrices import require_length
from noack.settings.registry import kinds_in, union_of

DISTURBANCES = kinds_in("noack.disturbances", DisturbanceSettings)
"""Settings classes by kind."""

if TYPE_CHECKING:
    AnyDisturbance = DisturbanceSettings
else:
    AnyDisturbance = union_of(DISTURBANCES)


def variance_at(place: Place, disturbances: Sequence[DisturbanceSettings], size: int) -> Vector:
    """Return the variance of all random disturbances at one place, shape (size,)."""
    variances = [one.variance for one in disturbances if one.at == place]
    return np.asarray(np.sum([np.zeros(size), *variances], axis=0))


def require_disturbances(
    disturbances: Sequence[DisturbanceSettings], n: int, m: int, *, linear: bool
) -> None:
    """Check that disturbances fit a plant.

    Args:
        disturbances: of the plant.
        n: number of states.
        m: number of inputs.
        linear: whether the plant is linear.

    Raises:
        ValueError: a disturbance does not fit; the message begins with the key.
    """
    for number, one in enumerate(disturbances):
        place = f"plant.disturbances.{number}"
        if one.at == "state" and not linear:
            raise ValueError(
                f'{place}.at: "state" needs a linear plant; this one can be disturbed at "input"'
            )
        size, why = (m, "one per input") if one.at == "input" else (n, "one per state")
        require_length(one.entries, f"{place}.{one.entries_key}", size, f'at = "{one.at}": {why}')
