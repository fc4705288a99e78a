"""The equations, compiled or not, give the library's values."""

from typing import Any

import numpy as np
import pytest

from noack.plants import vehicle as compiled
from noack.plants.four_tank import FourTankSettings
from noack.plants.vehicle import VehicleSettings, equations, library

CARS = (1, 2, 3)
WIDTHS = {"ks": 5, "st": 7, "std": 9, "mb": 29}


def parameters(car: int) -> Any:
    return library(f"parameters_vehicle{car}")()


def states(model: str, p: Any) -> np.ndarray:
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
def test_the_equations_give_the_librarys_values(model: str, car: int) -> None:
    p = parameters(car)
    rates, dynamics = equations(model, p), library(f"vehicle_dynamics_{model}")
    compared = 0
    for z in states(model, p):
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


@pytest.mark.parametrize(("model", "is_compiled"), [("st", False), ("std", True), ("mb", True)])
def test_equations_with_tyres_are_compiled(model: str, is_compiled: bool) -> None:
    assert (compiled.compiled_dynamics(model) is not None) == is_compiled
    assert compiled.is_compiled(model)


def test_the_given_parameters_are_used() -> None:
    slippery, grippy = parameters(2), parameters(2)
    slippery.tire.p_dy1 *= 0.1
    z = states("std", grippy)[-1]
    rates = [equations("std", p)(z, 0.0, 0.0) for p in (slippery, grippy)]
    assert np.abs(rates[0] - rates[1]).max() > 0.1


def test_equations_that_cannot_be_compiled_are_run_in_python(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def dynamics(z: Any, inputs: Any, p: Any) -> Any:
        return [eval("2 * value") for value in z]

    monkeypatch.setattr(compiled, "_dynamics", lambda model: dynamics)
    monkeypatch.setattr(compiled, "_COMPILED", ("other",))
    uncached = compiled.compiled_dynamics.__wrapped__
    monkeypatch.setattr(compiled, "compiled_dynamics", uncached)
    rates = equations("other", parameters(2))
    assert rates(np.array([1.0, 3.0]), 0.0, 0.0).tolist() == [2.0, 6.0]
    lines = capsys.readouterr().err.splitlines()
    assert lines[-1].startswith("noack: warning: the vehicle's equations stay slow")


def test_the_equations_are_compiled_once_before_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []
    monkeypatch.setattr(compiled, "compiled_dynamics", made.append)
    monkeypatch.setattr(compiled, "is_compiled", lambda model: model == "st")
    VehicleSettings(kind="vehicle").prepare()
    VehicleSettings(kind="vehicle", model="multi_body").prepare()
    VehicleSettings(kind="vehicle", model="kinematic", parameters="truck").prepare()
    FourTankSettings(kind="four_tank").prepare()
    assert made == ["mb", "kst"]
