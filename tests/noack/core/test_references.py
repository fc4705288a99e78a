"""References against numpy and closed forms: their values, and the flow of a model about them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from noack.core.core_library import core, ffi
from noack.core.linear_systems import Propagator
from noack.core.references import ModelFlow, Reference, ReferenceInForce, ReferenceSegment

H = np.array([[0.0, 1.0], [-1.0, -1.5]])
X = np.array([1.0, -0.5])
S = 10**9


def segments(seed: int) -> list[ReferenceSegment]:
    rng = np.random.default_rng(seed)
    return [
        ReferenceSegment(
            begin_ns,
            rng.normal(size=(3, 3)),
            rng.uniform(0.1, 5, waves),
            rng.normal(size=(waves, 3)),
            rng.normal(size=(waves, 3)),
        )
        for begin_ns, waves in ((0, 2), (S, 0), (3 * S // 2, 1))
    ]


@given(st.floats(-1e6, 1e6))
def test_sine_and_cosine_are_those_of_numpy(turns: float) -> None:
    parts = ffi.new("double[2]")
    core.noack_sine_and_cosine(turns, parts)
    angle = 2 * np.pi * float(np.remainder(turns, 1.0))
    assert list(parts) == pytest.approx([np.sin(angle), np.cos(angle)], abs=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_the_core_evaluates_polynomials_and_waves_as_numpy_does(seed: int) -> None:
    parts = segments(seed)
    times_ns = np.arange(0, 3 * S, S // 8)
    rows = Reference(parts, 2).rows(times_ns)
    for t_ns, row in zip(times_ns.tolist(), rows, strict=True):
        segment = [part for part in parts if part.begin_ns <= t_ns][-1]
        assert row == pytest.approx(segment.at((t_ns - segment.begin_ns) / S), rel=1e-13, abs=1e-13)


def test_without_a_reference_the_flow_is_the_propagator_bit_for_bit() -> None:
    assert ModelFlow(H)(X, 3, S).tobytes() == Propagator(H)(X, S - 3).tobytes()


@given(st.lists(st.integers(1, 5 * S), min_size=2, max_size=8, unique=True))
def test_changes_of_the_set_point_during_the_flow_apply_from_their_times(times: list[int]) -> None:
    *inner, end_ns = sorted(times)
    in_force, by_hand, now_ns, x_r = ReferenceInForce(None, 2, 1), X, 0, np.zeros(2)
    for number, t_ns in enumerate(inner):
        by_hand = x_r + expm(H * (t_ns - now_ns) * 1e-9) @ (by_hand - x_r)
        now_ns, x_r = t_ns, np.array([float(number), 0.0])
        in_force.change(t_ns, Reference.constant(x_r, np.zeros(1)))
    by_hand = x_r + expm(H * (end_ns - now_ns) * 1e-9) @ (by_hand - x_r)
    assert ModelFlow(H, in_force.reference)(X, 0, end_ns) == pytest.approx(by_hand, abs=1e-9)


def test_the_flow_integrates_the_model_about_a_moving_reference() -> None:
    """d(x − x_r)/dt = H (x − x_r) within each segment; x does not jump where x_r does."""
    parts, x, begin_ns = segments(7), X, S // 4
    for part, end_ns in zip(parts, (S, 3 * S // 2, 2 * S), strict=True):

        def rate(t_s: float, x: np.ndarray, part: ReferenceSegment = part) -> np.ndarray:
            here, step = t_s - part.begin_ns / S, 1e-6
            slope = (part.at(here + step) - part.at(here - step))[:2] / (2 * step)
            return np.asarray(slope + H @ (x - part.at(here)[:2]))

        x = solve_ivp(rate, (begin_ns / S, end_ns / S), x, rtol=1e-10, atol=1e-10).y[:, -1]
        begin_ns = end_ns
    flow = ModelFlow(H, Reference(parts, 2))
    assert flow(X, S // 4, 2 * S) == pytest.approx(x, abs=1e-7)
