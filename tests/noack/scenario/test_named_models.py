import numpy as np
import pytest

from noack.scenario.named_models import (
    NAMED_MODELS,
    double_integrator,
    lane_following,
    parameters_of,
)


def test_the_lane_model_is_the_papers() -> None:
    """The equations of Section V, written out, with its numbers: U = −12, d = 40, gain 1."""
    model = lane_following()
    rng = np.random.default_rng(0)
    (V, r, psi, Y_g), (u_1, u_2) = rng.uniform(-1, 1, 4), rng.uniform(-1, 1, 2)
    expected = [
        -1.6579 * V + 10.45 * r - 12.1053 * u_1,
        0.4886 * V - 2.718 * r + 13.1429 * u_2,
        r,
        V - 12 * psi,
    ]
    state = np.array([V, r, psi, Y_g])
    np.testing.assert_allclose(model.A @ state + model.B @ [u_1, u_2], expected, rtol=1e-14)
    np.testing.assert_allclose(model.K @ state, [Y_g / 40 - psi] * 2, rtol=1e-14)
    assert model.state_names == ("V", "r", "psi", "Y_g")


def test_the_papers_alpha_is_below_the_lane_examples_decay_rate() -> None:
    """eig(Â + B̂K) = {−1.126 ± 2.481i, −1.759, −0.365}: α = 0.25 is below 0.365."""
    model = lane_following()
    found = sorted(
        np.linalg.eigvals(model.A + model.B @ model.K), key=lambda value: (value.real, value.imag)
    )
    expected = [-1.759, -1.126 - 2.481j, -1.126 + 2.481j, -0.365]
    np.testing.assert_allclose(found, expected, atol=5e-4)  # three decimals


def test_the_double_integrator_has_the_poles_of_its_spring_and_damper() -> None:
    model = double_integrator(stiffness=6.0, damping=5.0)
    found = np.linalg.eigvals(model.A + model.B @ model.K)
    np.testing.assert_allclose(sorted(found), [-3.0, -2.0], rtol=1e-12)  # s² + 5 s + 6


@pytest.mark.parametrize("name", NAMED_MODELS)
def test_every_parameter_of_a_named_model_matters(name: str) -> None:
    def numbers(**parameters: float) -> bytes:
        model = NAMED_MODELS[name](**parameters)
        return b"".join(matrix.tobytes() for matrix in model[:3])

    for parameter in parameters_of(name):
        assert numbers(**{parameter: 7.5}) != numbers(), parameter
