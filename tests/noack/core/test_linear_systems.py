import math
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.integrate import solve_ivp

from noack.core.linear_systems import (
    Matrix,
    Propagator,
    discretise,
    norm,
    product,
    row_norms,
    spectral_abscissa,
    transition,
)

ROUNDING = 1e-13
"""A few hundred operations, each with a relative error of 2⁻⁵³."""

STEPS_NS = [1, 1_000, 2_000_000, 333_333_333, 1_000_000_000]


def square(n: int) -> st.SearchStrategy[Matrix]:
    return arrays(np.float64, (n, n), elements=st.floats(-1, 1))


generators = st.integers(1, 5).flatmap(square)
steps_ns = st.integers(0, 2_000_000_000)


@st.composite
def systems(draw: st.DrawFn) -> tuple[Matrix, Matrix]:
    n, m = draw(st.integers(1, 5)), draw(st.integers(1, 3))
    return draw(square(n)), draw(arrays(np.float64, (n, m), elements=st.floats(-1, 1)))


@pytest.mark.parametrize("dt_ns", STEPS_NS)
@pytest.mark.parametrize("a", [-30.0, -1.0, -1e-9, 0.0, 0.5, 20.0])
def test_a_scalar_system_is_discretised_as_its_closed_form(a: float, dt_ns: int) -> None:
    dt, b = dt_ns * 1e-9, 3.0
    Ad, Bd = discretise(np.array([[a]]), np.array([[b]]), dt_ns)
    assert Ad.item() == pytest.approx(math.exp(a * dt), rel=ROUNDING)
    assert Bd.item() == pytest.approx(b * (math.expm1(a * dt) / a if a else dt), rel=ROUNDING)


def test_a_singular_matrix_that_is_not_nilpotent_is_discretised_as_its_closed_form() -> None:
    v, w, dt = np.array([1.0, -2.0, 0.5]), np.array([0.3, 0.1, -1.0]), 0.7
    A, rate = np.outer(v, w), float(w @ v)  # A² = rate · A gives the series a closed form
    B = np.array([[1.0, 0.0], [0.0, 2.0], [-1.0, 1.0]])
    Ad, Bd = discretise(A, B, 700_000_000)
    grown = math.expm1(rate * dt)
    np.testing.assert_allclose(Ad, np.eye(3) + grown / rate * A, rtol=ROUNDING, atol=ROUNDING)
    expected = dt * B + (grown - rate * dt) / rate**2 * A @ B
    np.testing.assert_allclose(Bd, expected, rtol=ROUNDING, atol=ROUNDING)


@given(systems(), st.integers(1, 500_000_000), st.integers(0, 2**32))
def test_a_held_input_gives_what_an_integrator_gives(
    system: tuple[Matrix, Matrix], dt_ns: int, seed: int
) -> None:
    A, B = system
    x0, u = np.split(np.random.default_rng(seed).uniform(-1, 1, sum(B.shape)), [len(A)])
    Ad, Bd = discretise(A, B, dt_ns)
    solution = solve_ivp(
        lambda t, x: A @ x + B @ u, (0.0, dt_ns * 1e-9), x0,
        method="DOP853", rtol=1e-12, atol=1e-12,
    )  # fmt: skip
    # The integrator's local errors of 1e-12 grow by at most e^{‖A‖ dt} ≤ e^2.5 over its few steps.
    np.testing.assert_allclose(Ad @ x0 + Bd @ u, solution.y[:, -1], atol=1e-9)


@given(generators, steps_ns, steps_ns)
def test_transitions_form_a_group(G: Matrix, s_ns: int, t_ns: int) -> None:
    first, second = transition(G, s_ns), transition(G, t_ns)
    scale = np.linalg.norm(first) * np.linalg.norm(second)
    np.testing.assert_allclose(second @ first, transition(G, s_ns + t_ns), atol=1e-13 * scale)


@given(generators, st.lists(st.integers(1, 10**9), min_size=1, max_size=5))
def test_cached_and_fresh_matrices_are_the_same_bits(A: Matrix, steps: list[int]) -> None:
    free, state = Propagator(A), np.ones(len(A))
    for dt_ns in [*steps, *reversed(steps)]:
        assert free.transition(dt_ns).tobytes() == transition(A, dt_ns).tobytes()
        assert free(state, dt_ns).tobytes() == Propagator(A)(state, dt_ns).tobytes()


def test_a_propagator_keeps_its_own_matrix() -> None:
    A = np.array([[-1.0]])
    free = Propagator(A)
    A[:] = 7.0
    assert free(np.array([1.0]), 10**9) == pytest.approx(math.exp(-1), rel=ROUNDING)


def test_zero_time_and_zero_dynamics_leave_the_state_unchanged() -> None:
    state, G = np.array([0.1, -0.0]), np.array([[0.3, 1.0], [-2.0, 0.4]])
    assert Propagator(G)(state, 0).tobytes() == state.tobytes()
    assert Propagator(np.zeros((2, 2)))(state, 10**12).tobytes() == state.tobytes()


@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 2**32))
def test_a_product_rounds_each_term_and_then_each_sum_from_the_left(
    p: int, n: int, seed: int
) -> None:
    random = np.random.default_rng(seed)
    matrix, vector = random.standard_normal((p, n)), random.standard_normal(n)
    by_hand = []
    for row in matrix:
        # The nearest float of an exact value is the definition of rounding.
        terms = [float(Fraction(float(a)) * Fraction(float(b))) for a, b in zip(row, vector)]  # noqa: B905
        total = terms[0]
        for term in terms[1:]:
            total = float(Fraction(total) + Fraction(term))
        by_hand.append(total)
    assert product(matrix, vector).tolist() == by_hand


@pytest.mark.parametrize("n", [3, 30])
def test_a_product_of_a_diverged_state_needs_no_warning(n: int) -> None:
    matrix = np.zeros((n, n))
    matrix[0, 0], vector = 1e300, np.full(n, math.inf)
    vector[1] = 1e300
    assert np.isnan(product(matrix, vector)).all()


def test_a_negative_zero_stays() -> None:
    for n in (1, 30):
        found = product(np.full((1, n), -1.0), np.zeros(n))
        assert math.copysign(1.0, found.item()) == -1.0


@given(st.lists(st.floats(), min_size=1, max_size=20))
def test_a_norm_is_the_hypotenuse(values: list[float]) -> None:
    # About 20 roundings; numbers below 2⁻¹⁰²² have fewer digits.
    expected = math.hypot(*values)
    assert norm(np.array(values)) == pytest.approx(expected, rel=1e-14, abs=1e-320, nan_ok=True)


def test_the_abscissa_is_the_largest_real_part() -> None:
    # Eigenvalues −0.5 ± 3i and −2, from the block structure.
    matrix = np.array([[-0.5, 3.0, 1.0], [-3.0, -0.5, 4.0], [0.0, 0.0, -2.0]])
    assert spectral_abscissa(matrix) == pytest.approx(-0.5, rel=ROUNDING)


@pytest.mark.parametrize("size", [1e300, 1e160, 1e-160, 1e-300, 5e-324])
def test_row_norms_neither_overflow_nor_vanish(size: float) -> None:
    rows = np.array([[3.0, 4.0], [0.0, -2.0], [0.0, 0.0]]) * size
    expected = [norm(row) for row in rows]
    np.testing.assert_allclose(row_norms(rows), expected, rtol=1e-12)
    # They equal numpy's where the squares do not overflow.
    safe = np.random.default_rng(1).normal(size=(100, 5)) * np.logspace(-130, 130, 100)[:, None]
    assert row_norms(safe).tobytes() == np.linalg.norm(safe, axis=1).tobytes()


def test_row_norms_of_non_finite_rows_are_not_finite() -> None:
    with np.errstate(invalid="ignore"):
        found = row_norms(np.array([[np.inf, 1.0], [np.nan, 1.0], [1.0, 0.0]]))
    np.testing.assert_array_equal(found, [np.inf, np.nan, 1.0])
