"""The linearisation of a nonlinear plant, compared with the loop's model."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.summary.plant_linearisation import linearisation, linearisation_rows
from cosim.analysis.summary.summary_model import LinearisationPart, NoLinearisationPart
from noack.scenario.resolution import LoopMatrices, loop_of, resolve
from noack.scenario.scenario_file import validate
from tests.helpers.shipped import resolved


def loop(name: str) -> LoopMatrices:
    return loop_of(resolved(name))


BOX = f"plant.uncertainty_A={[[1e-3] * 4] * 4}", f"plant.uncertainty_B={[[1e-3] * 2] * 4}"


def test_a_summary_compares_the_tanks_linearisation_with_the_model() -> None:
    linearised = linearisation(resolved("four_tank", *BOX))
    assert isinstance(linearised, LinearisationPart)
    assert linearised.in_box is True
    believed = loop("four_tank")
    np.testing.assert_allclose(np.array(linearised.A) - linearised.off_A, believed.A_model, atol=1e-12)
    np.testing.assert_allclose(np.array(linearised.B) - linearised.off_B, believed.B_model, atol=1e-12)
    poles = np.linalg.eigvals(np.array(linearised.A) + np.array(linearised.B) @ believed.K)
    assert max(real for real, _ in linearised.eigenvalues) == pytest.approx(poles.real.max())
    assert linearisation_rows(linearised)[1][1].endswith("inside the box")
    # The second pump gives k_2 = 3.0 in place of 3.35: its share 0.6 goes into tank 2, of 32 cm².
    other = linearisation(resolved("four_tank", *BOX, "plant.system.pumps_cm3_per_v_s=[3.33, 3.0]"))
    assert isinstance(other, LinearisationPart)
    assert other.in_box is False
    assert np.abs(np.array(other.off_B)).max() == pytest.approx(0.6 * 0.35 / 32)
    assert linearisation_rows(other)[1][1] == "B[2, 2], by 0.00656, outside the box"
    without = linearisation(resolved("cart_pole"))
    assert isinstance(without, LinearisationPart)
    assert without.in_box is None
    assert linearisation(resolved("lane_following")) is None


def test_a_plant_whose_state_is_not_x_has_no_linearisation(tmp_path: Path, content: dict[str, Any]) -> None:
    file = tmp_path / "fixed.py"
    file.write_text(
        "class Fixed:\n"
        "    def start(self, x0):\n"
        "        self.x = 0 * x0\n"
        "    def advance(self, u, t_s, dt_s):\n"
        "        self.x = self.x + dt_s\n"
    )
    content["plant"]["system"] = {"kind": "python", "name": "Fixed", "file": str(file)}
    none = linearisation(resolve(validate(content, "here")))
    assert isinstance(none, NoLinearisationPart)
    assert linearisation_rows(none)[0][1].startswith("none: x is not its whole state")
