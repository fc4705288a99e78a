"""Certificates under the paper's conditions, against its loop in exact continuous time."""

import numpy as np
import pytest
from hypothesis import given, settings

from noack.theory.bounds.terms import NetworkConditions
from tests.noack.theory.exact_loops import observe
from tests.noack.theory.loops import (
    ROUNDING,
    SEARCH,
    System,
    certified_or_skipped,
    seeds,
    systems,
)


def shares(system: System, seed: int) -> dict[str, float]:
    """The largest share of each bound that a run uses; above 1, the bound is exceeded."""
    constants = certified_or_skipped(system, NetworkConditions(system.mansd))
    found = dict.fromkeys(("e_s", "e_c", "x", "x_W", "p", "inter-event time"), 0.0)
    for run, samples in observe(system, 12.0, seed):
        growth = np.exp(system.alpha * samples.t_s)
        # With an unknown x(0), sensor and controller agree only from event 0, at t = 0, on.
        known = np.ones(len(growth), bool)
        if not system.known_start:
            known[len(growth) - len(run.before)] = False
        weighted = np.linalg.norm(samples.x @ system.weight.T, axis=1)
        seen = {
            "e_s": (run.system.norms(samples.e_s), constants.overshoot * system.beta),
            "e_c": (run.system.norms(samples.e_c), constants.delta * system.beta),
            "x": (np.linalg.norm(samples.x, axis=1), constants.state),
            "x_W": (weighted, constants.state_weighted),
            "p": (np.linalg.norm(samples.e_c @ system.K.T, axis=1), constants.input_error),
        }
        for name, (values, bound) in seen.items():
            found[name] = max(found[name], float((growth * values)[known].max() / bound))
        if len(run.before) > 1:
            share = (constants.inter_event_s or 0.0) / float(np.diff(run.event_s).min())
            found["inter-event time"] = max(found["inter-event time"], share)
    return found


@settings(SEARCH, max_examples=12)
@given(systems(), seeds)
def test_no_bound_is_exceeded_in_continuous_time(system: System, seed: int) -> None:
    assert [name for name, share in shares(system, seed).items() if share > ROUNDING] == []


def test_all_bounds_are_nearly_reached_and_none_is_exceeded_where_there_are_many_events() -> None:
    """The plant is far from its model. Bounds that were smaller by a fifth would be exceeded."""
    largest: dict[str, float] = {}

    @settings(SEARCH, max_examples=15)
    @given(systems(n=2, mansd=4, mismatch=0.5, beta=0.01), seeds)
    def look(system: System, seed: int) -> None:
        for name, share in shares(system, seed).items():
            largest[name] = max(largest.get(name, 0.0), share)

    look()
    assert max(largest.values()) <= ROUNDING
    assert largest["e_s"] == pytest.approx(1.0, abs=1e-9)
    for name, least in (("e_c", 0.9), ("x", 0.95), ("p", 0.8), ("inter-event time", 0.85)):
        assert largest[name] > least, name
