"""Random exact simulations, for a core that is built with sanitizers; test_sanitized.py runs it."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cosim.simulation.exact_simulation import ExactSimulation, run_with_events
from noack.core.core_library import core, ffi
from noack.trigger.trigger_rule import TriggerRule
from tests.cosim.simulation.batch.exact import random_population, random_setting
from tests.trigger_rules import TABLES, area_rule, decaying_rule, random_rule

ANY_DOUBLE = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.integers(1, 20), st.integers(1, 3), st.sampled_from([*TABLES, ""]))
def test_random_batches(seed: int, n: int, m: int, policy: str) -> None:
    rng = np.random.default_rng(seed)
    setting = random_setting(rng, n, m)
    if policy and n <= 6:
        trigger = random_rule(policy, rng, n, setting.trigger.weight) if n == 2 else setting.trigger
        setting = setting.__class__(**{**vars(setting), "trigger": trigger, "most_events": 200})
    rows, events = run_with_events(setting, random_population(rng, setting, 2))
    assert [len(one.event_s) for one in events] == rows["transmissions"].tolist()


@settings(max_examples=60)
@given(st.data(), st.integers(1, 9), st.sampled_from(range(5)), st.booleans())
def test_matrices_and_states_of_any_numbers(
    data: st.DataObject, n: int, measure: int, area: bool
) -> None:
    """Infinite and undefined numbers end a run; they do not lead astray."""

    def any_of(*shape: int) -> np.ndarray:
        count = int(np.prod(shape))
        return np.array(data.draw(st.lists(ANY_DOUBLE, min_size=count, max_size=count))).reshape(
            shape
        )

    trigger = area_rule(0.1, n=n) if area else decaying_rule(0.5, 1.0, 0.1, n=n)
    simulation = ExactSimulation(
        any_of(n, n), any_of(1, n), trigger, horizon_s=2.0, known_start=measure > 2,
        delivered=np.array([True, False]), most_events=20, measure=measure,
    )  # fmt: skip
    A, B, x0 = any_of(2, n, n), any_of(2, n, 1), any_of(2, n)
    simulation.runs(A, B, x0, places=3, states=True)
    simulation.segments(A[0], B[0], any_of(2), any_of(2, 3, n), any_of(2))
    t_s = np.sort(any_of(4))
    simulation.sample(A[0], B[0], t_s[:2], any_of(2, 3, n), t_s)


def test_what_does_not_fit_is_refused() -> None:
    plain = {"horizon_s": 1.0, "known_start": True}
    one, trigger = np.eye(2), decaying_rule(0.5, 1.0)
    for wrong in (
        {"horizon_s": np.nan}, {"horizon_s": -1.0}, {"settle": np.inf}, {"measure": 9},
        {"measure": -1}, {"fading_per_s": -1.0}, {"most_events": -1}, {"event_places": 3},
        {"H": None}, {"K": None}, {"n": 0}, {"m": 65}, {"fate_count": 1},
    ):  # fmt: skip
        numbers = {name: ffi.NULL if value is None else value for name, value in wrong.items()}
        with pytest.raises(ValueError, match=r"a (simulation|loop) has"):
            _refused(one, trigger, {**plain, **numbers})
    for field, value in (
        ("level", -1.0), ("level", np.nan), ("rate_per_s", np.inf), ("floor", -1.0),
        ("up_rows", 257), ("up_rows", -1), ("down_rows", 2), ("grid_ns", -1), ("shortest_ns", -1),
        ("longest_ns", -1), ("longest_ns", 2**63 - 1), ("idle_ns", -(2**63)), ("decay_per_s", -1.0),
    ):  # fmt: skip
        simulation = ExactSimulation(one, one, trigger, **plain)
        setattr(simulation.core.rule, field, value)
        assert core.noack_exact_check(simulation.core) != ffi.NULL, field


def _refused(one: np.ndarray, trigger: TriggerRule, numbers: dict[str, object]) -> None:
    """Change a simulation's numbers, and check it again."""
    simulation = ExactSimulation(one, one, trigger, horizon_s=1.0, known_start=True)
    for name, value in numbers.items():
        setattr(simulation.core, name, value)
    mistake = core.noack_exact_check(simulation.core)
    if mistake != ffi.NULL:
        raise ValueError(ffi.string(mistake).decode())
