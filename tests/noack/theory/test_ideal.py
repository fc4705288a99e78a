"""Certificates under the paper's conditions, against its loop in exact continuous time."""

import dataclasses

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, assume, find, given, settings
from hypothesis import strategies as st

from noack.theory.certificate import Constants, NetworkConditions, VoidError
from tests.noack.theory.exact_loops import observe
from tests.noack.theory.loops import System, systems

ROUNDING = 1 + 1e-9
SYSTEMS = 25
EVENTFUL = {"mismatch": 0.5, "beta": 0.01}

SEARCH = settings(deadline=None, suppress_health_check=list(HealthCheck), phases=[Phase.generate])

seeds = st.integers(0, 2**32)


def certified(system: System, dropouts: int | None = None) -> Constants:
    try:
        return system.certify(NetworkConditions(system.mansd if dropouts is None else dropouts))
    except VoidError:
        assume(False)
        raise


def shares(system: System, constants: Constants, seed: int) -> dict[str, float]:
    """The largest share of each bound that a run uses; above 1, the bound is exceeded."""
    found = dict.fromkeys(("e_s", "e_c", "x", "x_W", "p", "inter-event time"), 0.0)
    speed = float(np.abs(np.linalg.eigvals(system.H)).max())
    for run, samples in observe(system, 12.0 / speed, seed):
        growth = np.exp(system.alpha * samples.t_s)
        # With an unknown x(0), sensor and controller agree only from event 0, at t = 0, on.
        known = np.ones(len(growth), bool)
        if not system.known_start:
            known[len(growth) - len(run.before)] = False
        seen = {
            "e_s": (run.system.norms(samples.e_s)[known], constants.overshoot * system.beta),
            "e_c": (run.system.norms(samples.e_c)[known], constants.delta * system.beta),
            "x": (np.linalg.norm(samples.x, axis=1)[known], constants.state),
            "x_W": (np.linalg.norm(samples.x @ system.weight.T, axis=1)[known],
                    constants.state_weighted),
            "p": (np.linalg.norm(samples.e_c @ system.K.T, axis=1)[known], constants.input_error),
        }  # fmt: skip
        for name, (values, bound) in seen.items():
            found[name] = max(found[name], float((growth[known] * values).max() / bound))
        if len(run.before) > 1:
            least_s = float(np.diff(run.event_s).min())
            found["inter-event time"] = max(
                found["inter-event time"], (constants.inter_event_s or 0.0) / least_s
            )
    return found


@settings(SEARCH, max_examples=SYSTEMS)
@given(systems(), seeds)
def test_no_bound_is_exceeded_in_continuous_time(system: System, seed: int) -> None:
    used = shares(system, certified(system), seed)
    assert [name for name, share in used.items() if share > ROUNDING] == []


def test_no_bound_is_exceeded_where_there_are_many_events_and_all_are_nearly_reached() -> None:
    """The plant is far from its model, so the runs come close to every bound."""
    largest: dict[str, float] = {}

    @settings(SEARCH, max_examples=15)
    @given(systems(n=2, mansd=4, **EVENTFUL), seeds)
    def look(system: System, seed: int) -> None:
        for name, share in shares(system, certified(system), seed).items():
            largest[name] = max(largest.get(name, 0.0), share)

    look()
    assert max(largest.values()) <= ROUNDING
    assert largest["e_s"] == pytest.approx(1.0, abs=1e-9)
    for name, least in (("e_c", 0.9), ("x", 0.95), ("p", 0.8), ("inter-event time", 0.85)):
        assert largest[name] > least, name


def test_one_dropout_forgotten_is_caught() -> None:
    def caught(case: tuple[System, int]) -> bool:
        system, seed = case
        try:
            forgetful = certified(system, system.mansd - 1)
            return shares(system, forgetful, seed)["e_c"] > ROUNDING
        except VoidError:
            return False

    find(
        st.tuples(systems(mansd=1, **EVENTFUL), seeds), caught,
        settings=settings(SEARCH, max_examples=60, database=None),
    )  # fmt: skip


def test_too_long_an_inter_event_time_is_caught() -> None:
    """δ is within a fifth of the largest possible value."""

    def caught(case: tuple[System, int]) -> bool:
        system, seed = case
        try:
            constants = certified(system)
        except VoidError:
            return False
        longer = constants._replace(inter_event_s=1.2 * (constants.inter_event_s or 0.0))
        return shares(system, longer, seed)["inter-event time"] > ROUNDING

    find(
        st.tuples(systems(n=1, mansd=0, **EVENTFUL), seeds), caught,
        settings=settings(SEARCH, max_examples=60, database=None),
    )  # fmt: skip


def test_a_level_lower_than_the_threshold_is_caught() -> None:
    def caught(case: tuple[System, int]) -> bool:
        system, seed = case
        lower = dataclasses.replace(system, beta=0.9 * system.beta)
        try:
            forgetful = certified(lower)
        except VoidError:
            return False
        # Δ and the overshoot are multiples of β.
        used = shares(system, forgetful, seed)
        return used["p"] > ROUNDING or used["x"] > ROUNDING

    find(
        st.tuples(systems(n=1, mansd=0, **EVENTFUL), seeds), caught,
        settings=settings(SEARCH, max_examples=60, database=None),
    )  # fmt: skip
