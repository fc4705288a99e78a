"""Inputs that cross the network: their losses and delays make updates act later, and inputs older."""

import functools
from typing import Any

import numpy as np
import pytest

from cosim.simulation.virtual_time import simulate
from noack.proof.elaborate.errors import RefusedError
from noack.proof.elaborate.scenario import read_linear_loop, read_loop
from noack.protocol.record_tables import PLANT_STEP, SENSOR_MEASUREMENT
from noack.scenario.resolution import resolve
from noack.theory.certificates.proven_bounds import ProvenBounds
from noack.theory.witnesses.documents import witness_by_gains
from noack.theory.witnesses.effort import NoWitnessError
from noack.theory.witnesses.outward import proven_bounds
from tests.helpers.bound_shares import share_of_bound
from tests.helpers.resolved_tables import resolved_tables
from tests.helpers.shipped import shipped

NAMES = ("unstable_pendulum", "double_integrator")
SETTINGS = ("horizon_s=4.0", 'network.loss={model="bernoulli", probability=0.8}')


@functools.cache
def proven(name: str, *settings: str) -> ProvenBounds:
    loop = read_loop(resolved_tables(name, *SETTINGS, *settings), box=False, ideal=False)
    return proven_bounds(witness_by_gains(loop, ("x", "e_s", "e_c")).proof, loop)


def sizes(bounds: ProvenBounds) -> dict[str, float]:
    return {output: sum(bound) for output, bound in bounds.bounds.items()}


def drawn(seed: int) -> tuple[str, ...]:
    rng = np.random.default_rng(seed)
    delay = ', impairments=[{kind="delay", delay_s=0.004}]' if rng.random() < 0.3 else ""
    losses = f'loss={{model="bernoulli", probability={rng.choice([0.3, 1.0])}}}'
    return (
        f"network.actuation={{mansd={rng.integers(0, 4)}, {losses}{delay}}}",
        f"controller.predictions={rng.integers(1, 5)}",
        f"controller.rate_hz={rng.choice([100, 200])}",
        f"seeds.loss={seed}",
    )


@pytest.mark.parametrize("name", NAMES)
def test_runs_that_lose_inputs_do_not_exceed_what_is_proven(name: str) -> None:
    largest = dict.fromkeys(("x", "e_s"), 0.0)
    for seed in range(4):
        record = simulate(resolve(shipped(name, *SETTINGS, *drawn(seed))))
        plant, sensor = record[PLANT_STEP], record[SENSOR_MEASUREMENT]
        values = {"x": (plant["t_ns"], plant["x"]), "e_s": (sensor["t_ns"], sensor["x_s"] - sensor["x"])}
        bounds = proven(name, *drawn(seed))
        for output, of_run in values.items():
            largest[output] = max(largest[output], share_of_bound(bounds, output, *of_run))
    assert 0.1 < max(largest.values()) <= 1


ONE = "network.actuation={mansd=1}"


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ((), (ONE,)),
        ((ONE,), ("network.actuation={mansd=2}",)),
        ((ONE,), ('network.actuation={mansd=1, impairments=[{kind="delay", delay_s=0.004}]}',)),
        ((ONE, "controller.predictions=2"), (ONE,)),
    ],
    ids=["a loss", "one loss more", "a delay", "fewer predictions"],
)
def test_each_condition_counts(before: tuple[str, ...], after: tuple[str, ...]) -> None:
    smaller, larger = sizes(proven(NAMES[1], *before)), sizes(proven(NAMES[1], *after))
    assert all(larger[name] > smaller[name] * 1.0001 for name in ("x", "e_c"))


def test_inputs_that_may_be_too_old_have_no_bound() -> None:
    with pytest.raises(NoWitnessError, match="times as large; a proof needs less than 1"):
        proven(NAMES[0], "network.actuation={mansd=40}", "controller.rate_hz=50")


@pytest.mark.parametrize("setting", [ONE, "controller.predictions=2"])
def test_the_growth_is_not_of_inputs_from_the_network(setting: str) -> None:
    tables: Any = resolved_tables(NAMES[0], setting, 'trigger={policy="periodic", period_s=0.01}')
    with pytest.raises(RefusedError, match=r"network\.actuation: the growth"):
        read_linear_loop(tables)
