"""Vehicles: CommonRoad's equations, and their states, inputs and outputs in the loop."""

from importlib import import_module
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from noack.core.errors import CallerError
from noack.plants.linear import single_track_lane
from noack.plants.plant_settings import OdeSystem
from noack.plants.systems import vehicle_compilation as compiled
from noack.plants.systems.linearisation import linearise
from noack.plants.systems.vehicle_compilation import library, model_rates
from noack.plants.vehicle import VehicleSettings
from tests.noack.plants.motion import H_NS, motion

X0 = np.array([0.2, -0.1, 0.05, 3.0])
CARS = ("ford_escort", "bmw_320i", "vw_vanagon")


def settings(**given: Any) -> VehicleSettings:
    return VehicleSettings(kind="vehicle", **given)


def parameters(car: str) -> Any:
    number = (*CARS, "truck").index(car) + 1
    name = f"parameters_vehicle{number}"
    return getattr(import_module(f"vehiclemodels.{name}"), name)()


def linearised(chosen: VehicleSettings) -> tuple[np.ndarray, np.ndarray]:
    linear = linearise(lambda x0: OdeSystem(chosen.equations(), x0), 4, 1, settling_s=chosen.settling_s)
    return linear.A, linear.B


@pytest.mark.parametrize("car", CARS)
def test_the_linearised_single_track_model_is_the_textbooks(car: str) -> None:
    """Riekert and Schunck's matrices, computed from the library's masses, axles and tyres."""
    p, v = parameters(car), 18.0
    per_weight = -p.tire.p_ky1 * p.m * 9.81 / (p.a + p.b)
    model = single_track_lane(
        mass_kg=p.m, inertia_kg_m2=p.I_z, front_m=p.a, rear_m=p.b,
        front_n_per_rad=per_weight * p.b, rear_n_per_rad=per_weight * p.a, speed_m_per_s=v,
    )  # fmt: skip
    A, B = linearised(settings(parameters=car, speed_m_per_s=v))
    np.testing.assert_allclose(A, model.A, atol=2e-3)
    np.testing.assert_allclose(B, model.B, rtol=1e-3, atol=2e-3)  # the servo has not fully settled


@pytest.mark.parametrize(("model", "library"), [("kinematic", "ks"), ("single_track", "st")])
def test_the_motion_agrees_with_another_solver_of_the_librarys_equations(model: str, library: str) -> None:
    """Over a lane change, with the servo written out; the larger models' equations are below."""
    chosen, p = settings(model=model, friction=1.0), parameters("bmw_320i")
    system = OdeSystem(chosen.equations(), X0)
    np.testing.assert_allclose(system.x[1:], X0[1:], rtol=1e-12)  # "kinematic" has fewer states
    assert len(system.z) == len(chosen.internal_names)
    name = f"vehicle_dynamics_{library}"
    dynamics = getattr(import_module(f"vehiclemodels.{name}"), name)

    def whole(t: float, z: np.ndarray, angle: float) -> Any:
        rates = [(angle - z[2]) / chosen.steering_s, chosen.speed_m_per_s - z[3]]
        return dynamics(list(z), rates, p)

    z = system.z
    for angle, steps in ((0.015, 100), (-0.02, 100)):
        motion(system, [angle] * steps)
        z = solve_ivp(whole, (0, steps * H_NS * 1e-9), z, args=(angle,), method="Radau",
                      rtol=1e-9, atol=1e-11).y[:, -1]  # fmt: skip
    np.testing.assert_allclose(system.z, z, atol=1e-7 * max(1.0, np.abs(z).max()))


@pytest.mark.parametrize(("given", "expected"), [
    ({"parameters": "truck"}, "parameters: the library has no masses"),
    ({"friction": 0.5}, 'friction: the model "single_track" has none'),
    ({"model": "kinematic", "parameters": "truck", "speed_m_per_s": 30.0},
     r"maximum speed of a truck is 22\.22 m/s"),
])  # fmt: skip
def test_settings_that_the_library_does_not_support_are_refused(given: dict[str, Any], expected: str) -> None:
    with pytest.raises((ValueError, CallerError), match=expected):
        OdeSystem(settings(**given).equations(), np.zeros(4))


WIDTHS = {"ks": 5, "st": 7, "std": 9, "mb": 29}


def driving_states(model: str, p: Any) -> np.ndarray:
    """States of normal and extreme driving: at the start, slow, spinning, sliding, tilted."""
    random = np.random.default_rng(7)
    core = [0.0, 1.0, 0.02, 15.0, 0.1, 0.2, 0.01]
    start = library(f"init_{model}")(core, p) if model in ("std", "mb") else core[: WIDTHS[model]]
    tried = np.array(start) + random.normal(size=(16, WIDTHS[model])) * 0.05
    # below 0.1 m/s the library uses a kinematic model
    tried[:5, 3] = random.uniform(-0.2, 0.2, 5)
    if model == "mb":
        tried[3:8, 23:27] *= -1.0  # wheels do not spin backwards
    return tried


@pytest.mark.parametrize("car", CARS)
@pytest.mark.parametrize("model", WIDTHS)
def test_the_equations_give_the_librarys_values(model: str, car: str) -> None:
    p = parameters(car)
    rates, dynamics = model_rates(model, p), library(f"vehicle_dynamics_{model}")
    compared = 0
    for z in driving_states(model, p):
        for inputs in ([0.1, -1.0], [-5.0, 30.0], [0.0, 0.0]):
            before = z.copy()
            try:
                expected = dynamics(z.tolist(), list(inputs), p)
            except ZeroDivisionError:  # for a wheel at standstill
                with pytest.raises(ZeroDivisionError):
                    rates(z, *inputs)
            else:
                compared += 1
                np.testing.assert_allclose(rates(z, *inputs), expected, rtol=1e-12, atol=1e-12)
            np.testing.assert_array_equal(z, before)
    assert compared > 30


def test_equations_that_cannot_be_compiled_are_run_in_python(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def dynamics(z: Any, inputs: Any, p: Any) -> Any:
        return [eval("2 * value") for value in z]

    def integrate(z: Any, v: Any, p: Any, duration_s: Any, tolerances: Any, work: Any) -> Any:
        return dynamics(z, v, p)

    monkeypatch.setattr(compiled, "_dynamics", lambda model: dynamics)
    monkeypatch.setattr(compiled, "_integrator", lambda dynamics: integrate)  # its own takes seconds
    monkeypatch.setattr(compiled, "_COMPILED", ("other",))
    uncached = compiled.compiled_dynamics.__wrapped__
    monkeypatch.setattr(compiled, "compiled_dynamics", uncached)
    rates = model_rates("other", parameters("bmw_320i"))
    assert rates(np.array([1.0, 3.0]), 0.0, 0.0).tolist() == [2.0, 6.0]
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("noack: warning: the vehicle's equations stay slow")


@pytest.mark.parametrize("model", ["kinematic", "multi_body"])
def test_a_vehicle_has_no_linearisation_if_x_is_not_its_state(model: str) -> None:
    """A kinematic vehicle has fewer states; a multi-body vehicle rolls as fast as it turns."""
    assert all(np.isnan(matrix).all() for matrix in linearised(settings(model=model)))


def test_without_the_library_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("noack.plants.plant_settings.find_spec", lambda name: None)
    with pytest.raises(CallerError, match=r"pip install 'noack\[vehicle\]'"):
        settings().require_installed()


def test_the_equations_are_compiled_once_before_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    monkeypatch.setattr(compiled, "compiled_dynamics", made.append)
    monkeypatch.setattr(compiled, "is_compiled", lambda model: model == "st")
    VehicleSettings(kind="vehicle").prepare()
    VehicleSettings(kind="vehicle", model="multi_body").prepare()
    VehicleSettings(kind="vehicle", model="kinematic", parameters="truck").prepare()
    assert made == ["mb", "kst"]
