"""Bounds of a margin's document: simulated runs stay within them, and noack-check verifies the files."""

import json
from pathlib import Path

import numpy as np
import pytest

import noack
from cosim.analysis.margin_proof import MarginProof, margin_proof
from cosim.analysis.margin_search import find_margin
from cosim.simulation.virtual_time import simulate
from noack.proof.words import in_words
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import load
from noack.theory.witnesses.loss_margin import LossMargin
from noack_kernel import prove

CASE = Path(__file__).parents[2] / "cases" / "drive_tie.toml"
SPEED = 50.0
KNOWN = 'network.initial_sync="known_state"'
SETPOINT = "controller.setpoint=[50.0, 0.1]"


def drive(*settings: str) -> Scenario:
    return resolve(load(CASE, ["horizon_s=1.5", "certificate.late_periods=1", *settings]))


def proved(resolved: Scenario) -> MarginProof:
    """Return what is proven for the losses of a scenario."""
    margin, losses = LossMargin(resolved), resolved.network.mansd
    found = [margin.stability(margin.guarantee.capped(k), 0.03) for k in range(losses + 1)]
    proof = margin_proof(margin, found, resolved.loop_outputs(), losses)
    assert proof is not None
    return proof


@pytest.mark.parametrize(
    "settings",
    [
        pytest.param((), id="a tie"),
        pytest.param(("controller.phase=0.25",), id="a hold"),
        pytest.param(("network.mansd=5",), id="five lost"),
        pytest.param(("network.impairments=[]", "plant.initial_state=[30.0, 5.0]"), id="no delay"),
        pytest.param(("controller.update_timeout_s=0.055",), id="a timeout"),
        pytest.param((KNOWN,), id="a known start"),
    ],
)
def test_simulated_runs_stay_within_what_is_proven(settings: tuple[str, ...]) -> None:
    resolved = drive(*settings)
    proof = proved(resolved)
    (bound,) = prove(proof.document, proof.proof).bounds
    assert bound.during_edges
    assert any("; so within 5 rad/s from " in line for line in proof.proven)
    rng, losses = np.random.default_rng(3), resolved.network.mansd
    delay_ns, nearest = int(LossMargin(resolved).delay_ns), 0.0
    for _ in range(6):
        fates = [True]
        while len(fates) < 400:
            fates += [*[False] * int(rng.integers(0, losses + 1)), True]
        # Where an update arrives at a tick, it may act at this one or at the next one.
        later = rng.integers(0, 2, len(fates)) * 80_000
        numbers = iter(range(len(fates)))

        def outcome(data: bytes, now_ns: int) -> int | None:
            number = next(numbers)  # noqa: B023
            return delay_ns + int(later[number]) if fates[number] else None  # noqa: B023

        steps = simulate(resolved, outcome)[PLANT_STEP]
        limit = float(bound.decaying) * np.exp(-float(bound.rate) * steps["t_ns"] * 1e-9) + float(
            bound.constant
        )
        share = np.abs(steps["x"][:, 0]) / limit
        assert share.max() < 1
        nearest = max(nearest, float(share.max()))
    assert nearest > 0.4


@pytest.mark.parametrize("settings", [(), (KNOWN,)])
def test_a_bound_is_about_the_set_point(settings: tuple[str, ...]) -> None:
    """There the integral of the error moves, in a loop whose states are those about the set-point."""
    moved = (*settings, "plant.initial_state=[0.0, 0.0]", SETPOINT)
    (bound,) = prove(*proved(drive(*moved))[1:]).bounds
    shares = []
    for seed in range(3):
        run = noack.simulate(load(CASE, ["horizon_s=1.5", f"seeds.loss={seed}", *moved]))
        steps = run.table(PLANT_STEP)
        t_s, speed = steps["t_s"].to_numpy(), steps["x_1"].to_numpy()
        limit = float(bound.decaying) * np.exp(-float(bound.rate) * t_s) + float(bound.constant)
        shares.append(float((np.abs(speed - SPEED) / limit).max()))
    assert 0.4 < max(shares) < 1


def test_the_files_of_a_margin_say_what_is_proven_of_some_locations() -> None:
    """One document has all losses; a statement about fewer is of the runs that visit only some locations."""
    result = find_margin(drive("certificate.late_periods=0"), with_period=False)
    assert result.stable_mansd == 11
    assert result.destabilised is not None
    assert result.destabilised.mansd == 13
    proof = result.proof
    assert proof is not None
    found = prove(proof.document, proof.proof)
    (bound,), (most, least) = found.bounds, found.growth
    assert bound.only is not None
    assert [name for name in bound.only if name.endswith("lost")] == [f"{k} lost" for k in range(4)]
    assert most.only is not None
    assert "11 lost" in most.only
    assert "12 lost" not in most.only
    assert most.factor < 1 < least.factor
    assert "13 lost" in in_words(json.loads(proof.document))
