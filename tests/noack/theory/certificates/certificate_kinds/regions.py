"""Regions of nonlinear plants: random equations, of which runs neither leave the region nor the bounds.

A plant is a linear one with a few more terms, which are 0 with their derivatives at 0. The loop, its
attackers and the integration are those of ``tests/oracles/attacked_regions.py``.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple
from unittest.mock import patch

import numpy as np

from noack.core.linear_systems import Vector
from noack.plants.systems.enclosed_motion import EnclosedMotion, Inclusion
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.theory.bounds.certificate_terms import NetworkConditions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.region import _Box
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.policies import scenario_of
from tests.noack.theory.certificates.certificate_kinds.shares import Case, drawn, shares_of
from tests.oracles import attacked_regions
from tests.oracles.attacked_regions import attacked, inclusion_share
from tests.oracles.lossy_loops import System, random_system

_RUNS, _STEPS, _POINTS = 40, 200, 500

TERMS: Sequence[Callable[[Any, Any], Any]] = (
    lambda p, q: np.sin(p) - p,
    lambda p, q: np.cos(p) - 1,
    lambda p, q: np.tan(p) - p,
    lambda p, q: np.arctan(p) - p,
    lambda p, q: np.tanh(p) * q,
    lambda p, q: np.exp(p) - 1 - p,
    lambda p, q: np.log(1 + p) - p,
    lambda p, q: np.sqrt(1 + p) - 1 - p / 2,
    lambda p, q: p / (1 + q**2) - p,
    lambda p, q: p * q,
    lambda p, q: p**2 * q,
    lambda p, q: p**3,
    lambda p, q: p**7,
)
"""p and q are linear functions of x and u."""


class RandomPlant:
    """dx/dt = Ax + Bu, and in some rows a term; a plant of kind "python"."""

    def __init__(self, linear: list[list[float]], terms: list[list[float]]) -> None:
        self._linear = np.array(linear)
        self._terms = [(int(row), int(number), np.array(c)) for row, number, *c in terms]

    def derivative(self, t_s: float, x: Any, u: Any) -> Any:
        """Return dx/dt of x, (n, …), and u, (m, …), numbers of any kind."""
        z = np.concatenate([x, u])
        rates = [*(self._linear @ z)]
        for row, number, (size, *coefficients) in self._terms:
            p, q = np.reshape(coefficients, (2, -1)) @ z
            rates[row] = rates[row] + size * TERMS[number](p, q)
        return np.array(rates)


class RegionLoop(NamedTuple):
    """A loop with a random plant, and where it starts."""

    resolved: Scenario
    case: attacked_regions.Case


def region_loop(
    system: System,
    terms: list[list[float]],
    semi_axes: Vector,
    beta: float,
    floor: float = 0.0,
    late: int = 0,
) -> RegionLoop:
    """A loop with these terms, each a row, a number, a size, and the coefficients of p and q."""
    parameters = {"linear": np.hstack([system.A, system.B]).tolist(), "terms": terms}
    rate = {"rate_hz": 1e9 / round(system.step_s * 1e9)}
    trigger = {
        "beta": beta, "floor": floor, "alpha_per_s": system.alpha, "weight": system.weight.tolist(),
    }  # fmt: skip
    kind = {"kind": "python", "name": f"{__name__}:RandomPlant", "parameters": parameters}
    resolved = resolve(scenario_of(
        system, trigger, plant={"system": kind, **rate}, controller=rate,
        certificate={"late_periods": late},
    ))  # fmt: skip
    plant = RandomPlant(**parameters)
    case = attacked_regions.Case("", lambda x, u: plant.derivative(0.0, x, u), tuple(semi_axes.tolist()))
    return RegionLoop(resolved, case)


def random_loop(rng: np.random.Generator) -> RegionLoop:
    """A loop with 1 to 3 states and 1 to 3 terms."""
    reach, n = 10 ** rng.uniform(-1.5, 0.3), int(rng.integers(1, 4))
    system = random_system(
        rng, n=n, m=1, spread=1.0, mansd=int(rng.integers(4)), mismatch=float(rng.choice([0.0, 0.05])),
        step_share=float(rng.choice([0.003, 0.01])),
    )  # fmt: skip
    terms = list[list[float]]()
    for number in rng.integers(len(TERMS), size=int(rng.integers(1, 4))).tolist():
        coefficients = rng.uniform(-1, 1, 2 * (n + 1)) * (rng.random(2 * (n + 1)) < 0.7)
        terms.append([float(rng.integers(n)), number, rng.uniform(-1, 1), *coefficients.tolist()])
    beta = system.beta * reach
    floor = float(rng.choice([0.0, 0.3])) * beta
    return region_loop(system, terms, reach * rng.uniform(0.1, 1, n), beta, floor, int(rng.integers(4)))


def _steep_loop(rng: np.random.Generator) -> RegionLoop:
    """A loop whose start drives it into a steep term."""
    A, B = np.array([[0.0, 1.0], [rng.uniform(0.95, 1.05), 0.0]]), np.eye(2)[:, 1:]
    K = np.array([[-4.0, -2.0]])
    system = replace(
        random_system(rng, n=2, m=1), A=A, B=B, K=K, H=A + B @ K, weight=np.eye(2), alpha=0.2, mansd=1,
        step_s=0.005,
    )  # fmt: skip
    cube = [1.0, len(TERMS) - 2.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    return region_loop(system, [cube], np.array([0.01, rng.uniform(4.2, 4.7)]), 0.001)


def _certified(case: Case) -> ScenarioCertificate | None:
    loop: RegionLoop = case.loop
    certificate = attacked_regions.certificate_of(loop.resolved, loop.case.semi_axes)
    return None if certificate.constants is None else certificate


def _simulate(case: Case, rng: np.random.Generator) -> Observed:
    (resolved, plant), region = case.loop, case.certified.region
    seed = int(rng.integers(2**32))
    with np.errstate(all="ignore"):  # those of a broken copy diverge
        shares = attacked(resolved, plant, case.certified, runs=_RUNS, steps=_STEPS, seed=seed)
        box = Inclusion(*(np.array(matrix) for matrix in region[2:]))
        used = inclusion_share(box, plant.field, np.array(region.x + region.u), _POINTS)
    return Observed(_RUNS, shares | {"inclusion": used})


_bounds = shares_of(("x", "u", "‖x‖", "‖e_s‖", "‖e_c‖", "inclusion"), _certified)
_over, _bounded = EnclosedMotion.over, _Box.bounded


def _no_remainder(motion: EnclosedMotion, widths: Vector) -> Inclusion:
    box = _over(motion, widths)
    return box._replace(halfwidth_A=0 * box.A, halfwidth_B=0 * box.B)


def _reaching(change: Callable[[_Box, Vector], Vector]) -> Callable[..., Any]:
    def bounded(box: _Box, conditions: NetworkConditions) -> Any:
        phases, reached = _bounded(box, conditions)
        return phases, change(box, reached)

    return bounded


def _broken(owner: type, name: str, wrong: Any, draw: Callable[..., RegionLoop]) -> Broken:
    def certify(case: Case) -> Bounds | None:
        with patch.object(owner, name, wrong):
            return _bounds(case)

    return Broken(certify, drawn(draw, {}))


REGIONS = Kind(
    "region", drawn(random_loop, {}), _bounds, _simulate,
    {
        "equations over half of the region": _broken(
            EnclosedMotion, "over", lambda motion, widths: _over(motion, widths / 2), random_loop
        ),
        "no remainder": _broken(EnclosedMotion, "over", _no_remainder, random_loop),
        "half of the bounds": _broken(
            _Box, "bounded", _reaching(lambda box, reached: reached / 2), random_loop
        ),
        "the first region": _broken(
            _Box, "bounded",
            _reaching(lambda box, reached: reached * (not box._constants._plants[0.0].halfwidth_A.any())),
            _steep_loop,
        ),
    },
)  # fmt: skip
