"""Certificates of nonlinear plants on regions: enclosures, attacks on the shipped ones, reasons."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.claim_evaluation import RunClaims
from cosim.analysis.claims.run_certificates import scheduled_certificates
from cosim.analysis.summary.summary_model import ClaimVerdict
from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import Vector
from noack.observers.luenberger import LuenbergerSettings
from noack.plants.linear import LinearSettings
from noack.plants.plant_settings import PlantStart
from noack.plants.systems.enclosed_motion import EnclosedMotion, Inclusion
from noack.plants.systems.traced_equations import trace
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.conditions import nominal_conditions
from noack.theory.certificates.network_limits import network_limit
from noack.theory.certificates.region import RegionScope, nonlinear_scope
from tests.oracles.attacked_regions import CASES, SCENARIOS, attacked, certificate_of, inclusion_share

arb = pytest.importorskip("flint").arb
REGIONS = {
    "pendulum": [1.2, 2.0, 9.0],
    "kinematic car": [0.4, 0.9, 5.0, 0.5],
    "cart-pole": [1.0, 2.0, 0.5, 3.0, 20.0],
    "four tanks": [4.0, 4.0, 1.2, 0.9, 2.0, 2.0],
}
LUENBERGER = LuenbergerSettings(kind="luenberger", gain=((0.2, 0.0), (0.0, 0.2)))


def over(resolved: Scenario, widths: Vector) -> Inclusion:
    loop = loop_of(resolved)
    start = PlantStart(np.zeros(loop.n), loop.A, loop.B, 1_000_000)
    return EnclosedMotion(resolved.plant.system.system(start), loop.n, loop.m).over(widths)


@pytest.mark.parametrize("name", CASES)
def test_equations_lie_in_their_enclosure(name: str) -> None:
    case, widths = CASES[name], np.array(REGIONS[name])
    resolved = resolve(load(SCENARIOS / f"{case.scenario}.toml"))
    for share in (1.0, 0.3):
        assert inclusion_share(over(resolved, share * widths), case.field, share * widths) <= 1
    assert inclusion_share(over(resolved, 0.5 * widths), case.field, widths) > 1.1


def test_a_sine_is_enclosed_almost_tightly() -> None:
    box = over(CASES["pendulum"].resolved(), np.array([1.0, 1.0, 1.0]))
    highest, lowest = (box.A[1, 0] + sign * box.halfwidth_A[1, 0] for sign in (1, -1))
    exact = 9.81 * np.sin(1.0)  # times sin(r)/r to 1
    assert highest >= 9.81 >= exact >= lowest
    assert highest - lowest < 1.35 * (9.81 - exact)
    assert not box.halfwidth_B.any()


class _Function:
    """A plant ẋ = f(x + middle) − f(middle)."""

    def __init__(self, of: Callable[[Any], Any], middle: float) -> None:
        self.of, self.middle = of, middle

    def expressions(self, t_s: Any, x: Any, u: Any) -> Any:
        return [self.of(x[0] + self.middle) - float(self.of(self.middle)) + 0 * u[0]], x


def chord_slopes(of: Callable[[Any], Any], middle: float, radius: float) -> Any:
    """Return a ball of the slopes of a function's chords from the middle of an interval."""
    system: Any = _Function(of, middle)
    plants = trace(system, 1, 1, np.array([radius, 1.0]), signals=False).plants
    return plants.A[0, 0] + arb(0, plants.half_A[0, 0].abs_upper())


@pytest.mark.parametrize(
    "of",
    [
        np.sin, np.cos, np.tan, np.arctan, np.tanh, np.sinh, np.cosh, np.exp, np.log, np.sqrt,
        lambda x: x**3 - 2 / x + x**-1.5, lambda x: (1 - x * x) / (x + np.cos(x)),
        lambda x: np.abs(-x) + max(x, 0.0), lambda x: np.array([x, 2 * x]) @ np.array([3.0, x]),
        lambda x: np.clip(x, 0.7, 1.0) + np.maximum(x, 0.8) * np.minimum(x, 1.1),
        lambda x: x - np.clip(x, 0.7, 1.0),
    ],
)  # fmt: skip
def test_slopes_of_chords_are_enclosed(of: Callable[[Any], Any]) -> None:
    middle, radius = 0.9, 0.3
    slopes = chord_slopes(of, middle, radius)
    points = np.linspace(middle - radius, middle + radius, 40)
    chords = [float(of(x) - of(middle)) / (x - middle) for x in points]
    assert all(slopes.lower() - 1e-9 <= chord <= slopes.upper() + 1e-9 for chord in chords)
    assert slopes.rad() < 2.5 * np.ptp(chords) + 0.01


@pytest.mark.parametrize(
    ("of", "slopes"), [(np.tanh, (0, 1)), (np.abs, (-1, 1)), (np.exp, (0, np.exp(40))), (np.arctan, (0, 1))]
)
def test_wide_intervals_have_enclosures(of: Callable[[Any], Any], slopes: tuple[float, float]) -> None:
    """Of an interval that is much wider than the range in which the function bends."""
    found = chord_slopes(of, 0.0, 40.0)
    assert found.abs_upper() <= 1.001 * slopes[1]
    assert found.lower() > slopes[0] - 0.01 * slopes[1]


KINKS = """class Kinks:
    def derivative(self, t_s, z, u):
        push = abs(z[0] - 0.3) - 0.3 + abs(u[0] + 2 * z[1]) * z[1]
        return [z[1] * abs(z[1]) - abs(z[0]), push + abs(abs(z[0]) - abs(u[0])) / 2]
"""


def test_equations_with_kinks_lie_in_their_enclosure(tmp_path: Path) -> None:
    own, namespace = own_plant(tmp_path, KINKS), dict[str, Any]()
    exec(KINKS, namespace)
    plant = namespace["Kinks"]()

    def field(x: Vector, u: Vector) -> Vector:
        return np.array(plant.derivative(0.0, x, u))

    for widths in ([0.5, 0.4, 2.0], [0.2, 3.0, 0.1], [5.0, 0.01, 0.3]):
        assert 0.2 < inclusion_share(over(own, np.array(widths)), field, np.array(widths)) <= 1


@pytest.mark.parametrize("name", CASES)
def test_no_attack_exceeds_a_bound_or_leaves_the_region(name: str) -> None:
    case = CASES[name]
    resolved = case.resolved()
    certificate = certificate_of(resolved, case.semi_axes)
    worst = attacked(resolved, case, certificate, runs=100, steps=500)
    assert all(0.05 < share < 1 for share in worst.values()), worst


def test_a_limit_is_that_of_the_region_and_not_of_the_linear_plant() -> None:
    resolved = CASES["pendulum"].resolved()
    scope, scheduled = RegionScope(resolved), nominal_conditions(resolved)
    limit_s = network_limit(scope, scheduled, "sampling")

    def at(t_s: float) -> ScenarioCertificate:
        return scope.certificate(scheduled._replace(spacing_s=t_s, sampling_s=t_s))

    assert at(limit_s).constants is not None
    assert at(1.01 * limit_s).constants is None


def own_plant(folder: Path, code: str) -> Scenario:
    (folder / "own.py").write_text(code)
    (folder / "own.toml").write_text(f"""
        name = "own"
        horizon_s = 2.0
        model = {{ A = [[0.0, 1.0], [1.0, 0.0]], B = [[0.0], [1.0]], gain = [[-4.0, -2.0]] }}
        controller = {{ rate_hz = 2000.0 }}
        trigger = {{ beta = 0.01, alpha_per_s = 0.2 }}
        network = {{ mansd = 3, loss = {{ model = "bernoulli", probability = 0.5 }} }}
        [plant]
        rate_hz = 2000.0
        system = {{ kind = "python", file = "own.py", name = "{code.split()[1][:-1]}" }}
        initial_state = [0.1, 0.0]
    """)
    return resolve(load(folder / "own.toml"))


FRICTION = """class Rubbing:
    def derivative(self, t_s, z, u):
        import numpy as np
        return [z[1], z[0] + u[0] - 0.01 * {term}]
"""


def test_linear_equations_have_the_certificates_of_a_linear_plant(tmp_path: Path) -> None:
    """From any x(0), also with an observer, and without a region."""
    code = """class Linear:
    def derivative(self, t_s, z, u):
        return [z[1], 1.5 * z[0] - 0.1 * z[1] + u[0]]
"""
    for start, settings in ((1.0, {}), (1e6, {}), (1.0, {"observer": LUENBERGER})):
        own = own_plant(tmp_path, code)
        moved = own.plant.model_copy(update={"initial_state": (start, 0.0)})
        own = own.model_copy(update={"plant": moved, **settings})
        matrices = {"A": ((0.0, 1.0), (1.5, -0.1)), "B": ((0.0,), (1.0,)), "system": LinearSettings()}
        linear = own.model_copy(update={"plant": moved.model_copy(update=matrices)})
        [certificate] = scheduled_certificates(own)
        [expected] = scheduled_certificates(linear)
        assert certificate.constants is not None
        assert certificate.constants == expected.constants
        assert certificate.persistent_constants == expected.persistent_constants
        assert certificate.region is None
        assert "the plant is ẋ = Ax + Bu" in {assumption.what for assumption in certificate.assumptions}


def test_equations_that_are_linear_near_0_only_are_not_linear(tmp_path: Path) -> None:
    for term in ("max(z[1] - 1e3, 0.0)", "1e-9 * z[1] ** 2", "np.sin(1e-6 * z[1])"):
        own = own_plant(tmp_path, FRICTION.format(term=term))
        assert isinstance(nonlinear_scope(own), RegionScope)


def test_a_run_is_held_against_its_region() -> None:
    for name, verdict in (("sine_pendulum", ClaimVerdict.HELD), ("cart_pole", ClaimVerdict.VOID)):
        record = simulate(resolve(load(SCENARIOS / f"{name}.toml", ["horizon_s=1.0"])))
        claims = [claim for claim in RunClaims(record).evaluate() if claim.source == "region certificate"]
        assert {claim.verdict for claim in claims} == {verdict}
        assert ("x stays in the region" in {claim.what for claim in claims}) == (name != "cart_pole")


@pytest.mark.parametrize(
    "setting",
    [
        'plant.disturbances=[{kind="uniform",bound=[0.05]}]',
        "plant.measurement={noise_bound=[3e-4,3e-4]}",
        'trigger={policy="absolute",delta=0.01}',
    ],
)
def test_what_persists_is_bounded_on_a_region(setting: str) -> None:
    resolved = resolve(load(SCENARIOS / "sine_pendulum.toml", ["horizon_s=1.0", setting]))
    scope, conditions = RegionScope(resolved), nominal_conditions(resolved)
    certificate = scope.certificate(conditions)
    assert certificate.persistent_constants is not None
    assert certificate.region is not None
    undisturbed = RegionScope(resolve(load(SCENARIOS / "sine_pendulum.toml"))).certificate(conditions)
    assert undisturbed.region is not None
    assert np.less(certificate.region.x, np.multiply(1.1, undisturbed.region.x)).all()
    claims = [
        claim for claim in RunClaims(simulate(resolved)).evaluate() if claim.source == "region certificate"
    ]
    assert {claim.verdict for claim in claims} == {ClaimVerdict.HELD}
