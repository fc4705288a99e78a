"""The linearisation of a nonlinear plant, compared with the loop's model."""

import numpy as np
import pytest

from cosim.analysis.summary.plant_linearisation import linearisation, linearisation_rows
from cosim.analysis.summary.summary_model import LinearisationPart, NoLinearisationPart
from noack.scenario.resolution import LoopMatrices, loop_of
from tests.helpers.shipped import resolved


def loop(name: str) -> LoopMatrices:
    return loop_of(resolved(name))


def test_a_summary_compares_the_cars_linearisation_with_the_model() -> None:
    linearised = linearisation(resolved("lane_vehicle"))
    assert isinstance(linearised, LinearisationPart)
    assert linearised.in_box is True
    assert max(real for real, _ in linearised.eigenvalues) == pytest.approx(-1.157, abs=2e-3)
    believed = loop("lane_vehicle")
    np.testing.assert_allclose(np.array(linearised.A) - linearised.off_A, believed.A_model, atol=1e-12)
    np.testing.assert_allclose(np.array(linearised.B) - linearised.off_B, believed.B_model, atol=1e-12)
    assert linearisation_rows(linearised)[1][1].endswith("inside the box")
    other = linearisation(resolved("lane_vehicle", "plant.system.parameters=vw_vanagon"))
    assert isinstance(other, LinearisationPart)
    assert other.in_box is False
    worst = np.abs(np.array(other.off_B)).max()
    assert linearisation_rows(other)[1][1] == f"B[2, 1], by {worst:.3g}, outside the box"
    without = linearisation(resolved("cart_pole"))
    assert isinstance(without, LinearisationPart)
    assert without.in_box is None
    assert linearisation(resolved("lane_following")) is None
    none = linearisation(resolved("lane_vehicle", "plant.system.model=kinematic"))
    assert isinstance(none, NoLinearisationPart)
    assert linearisation_rows(none)[0][1].startswith("none: x is not its whole state")
