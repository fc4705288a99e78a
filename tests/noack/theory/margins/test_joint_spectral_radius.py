"""The bounds of joint spectral radii, against closed forms.

``certificate_kinds/margins.py`` has brute force; a published value is in ``tests/published``.
"""

import numpy as np
import pytest

from noack.core.linear_systems import Matrix
from noack.theory.margins.exact_matrices import IntervalMatrix, exactly
from noack.theory.margins.invariant_polytopes import InvariantPolytopes, PolytopeNorm
from noack.theory.margins.joint_spectral_radius import bound_by_products, joint_spectral_radius
from noack.theory.margins.quadratic_norms import NormSearch, with_history
from noack.theory.margins.switched_system import Edge, SwitchedSystem, spectral_radius_bounds

GOLDEN_RATIO = (1 + 5**0.5) / 2


def edge(source: int, target: int, matrix: Matrix, duration: int = 1) -> Edge:
    return Edge(source, target, exactly(np.array(matrix, dtype=float)), duration)


@pytest.mark.parametrize(
    ("matrices", "value"),
    [
        ([[[1, 1], [0, 1]], [[1, 0], [1, 1]]], GOLDEN_RATIO),
        ([[[0, -1], [1, 0]], [[0.6, -0.8], [0.8, 0.6]]], 1.0),  # rotations
        ([[[0, 2], [0, 0]], [[0, 0], [0.125, 0]]], 0.5),  # each alone is nilpotent
        ([[[0.5, 1], [0, 0.5]]], 0.5),  # defective
        ([[[3]], [[-5]]], 5.0),
    ],
)
def test_the_joint_spectral_radius_is_that_of_the_closed_form(matrices: list[Matrix], value: float) -> None:
    bounds = joint_spectral_radius([edge(0, 0, matrix) for matrix in matrices], accuracy=1e-6)
    assert bounds.lower <= value * (1 + 1e-15)
    assert bounds.upper >= value
    assert bounds.lower == pytest.approx(value, rel=1e-7)
    assert bounds.upper == pytest.approx(value, rel=6e-3)  # the defective one needs many vertices


def random_graph(rng: np.random.Generator) -> list[Edge]:
    """A graph of up to 3 nodes with random edges; a ring connects all nodes."""
    nodes, n = int(rng.integers(1, 4)), int(rng.integers(1, 4))
    pairs = [(i, (i + 1) % nodes) for i in range(nodes)]
    pairs += [(i, j) for i in range(nodes) for j in range(nodes) if rng.random() < 0.4]
    return [edge(i, j, rng.normal(size=(n, n)), int(rng.integers(1, 3))) for i, j in pairs]


@pytest.mark.parametrize("seed", range(10))
def test_no_polytope_proves_a_bound_below_the_growth(seed: int) -> None:
    """The bound is valid for any vertices, also if they were not grown to the end."""
    rng = np.random.default_rng(seed)
    edges = random_graph(rng)
    system, value = SwitchedSystem.of(edges), joint_spectral_radius(edges, accuracy=1e-3).lower
    n = system.dimension
    vertices = [
        np.concatenate([np.diag(rng.uniform(0.01, 2, n)), rng.normal(size=(5, n))])
        for _ in range(system.graph.nodes)
    ]
    polytopes = InvariantPolytopes(system, value * rng.uniform(0.5, 2), vertices)
    assert polytopes.bound() >= value
    polytopes.grow(30)
    assert polytopes.bound() >= value


def test_the_norm_of_a_polytope_counts_what_its_combinations_miss() -> None:
    point = IntervalMatrix(np.array([[0.5, -0.25]]), np.array([[0.1, 0.2]]))
    (bound,) = PolytopeNorm(np.diag([1.0, 0.5])).bounds(point)
    assert bound == pytest.approx(0.6 + 0.45 / 0.5)


def scaled(edges: list[Edge], factor: float) -> list[Edge]:
    """The same system, whose growth is multiplied by a factor."""
    return [edge(step.source, step.target, step.matrix.middle * factor**step.duration, step.duration)
            for step in edges]  # fmt: skip


@pytest.mark.parametrize("seed", range(8))
def test_a_growth_near_the_threshold_is_decided(seed: int) -> None:
    edges = random_graph(np.random.default_rng(seed))
    sharp = joint_spectral_radius(edges, accuracy=1e-5).lower
    for wanted in (0.999, 1.001):
        bounds = joint_spectral_radius(scaled(edges, wanted / sharp), accuracy=0.1, threshold=1.0)
        assert (bounds.upper < 1) == (wanted < 1)
        assert (bounds.lower > 1) == (wanted > 1)
        assert bounds.needed_effort == 0


def test_the_estimate_of_the_work_is_mostly_that_of_a_complete_search() -> None:
    ratios = []
    for seed in range(12):
        edges = random_graph(np.random.default_rng(seed))
        slowest = joint_spectral_radius(edges, accuracy=1e-3).lower
        balanced, growth = SwitchedSystem.of(edges).balanced(), 1.05 * slowest
        complete = bound_by_products(balanced, growth, 60_000, slowest=slowest)
        assert complete.upper <= growth
        assert complete.needed_products == complete.products
        part = bound_by_products(balanced, growth, complete.products // 4, slowest=slowest)
        ratios.append(part.needed_products / complete.products)
    assert min(ratios) > 0.2
    assert 0.5 < np.median(ratios) < 2


def test_a_growth_that_is_the_threshold_is_undecided() -> None:
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    bounds = joint_spectral_radius([edge(0, 0, turn), edge(0, 0, turn.T)], threshold=1.0, effort=0.1)
    assert bounds.lower <= 1 <= bounds.upper < 1 + 1e-3
    assert bounds.needed_effort == np.inf


@pytest.mark.parametrize("seed", range(10))
def test_no_norms_and_no_products_prove_a_bound_below_the_growth(seed: int) -> None:
    """Their bounds hold in any coordinates; a broken copy without the best cycle is caught."""
    rng = np.random.default_rng(seed)
    edges = random_graph(rng)
    system, bounds = SwitchedSystem.of(edges), joint_spectral_radius(edges, accuracy=1e-3)
    norms = NormSearch(system).improve(0.0)
    assert bounds.lower <= norms.upper
    assert bounds.lower <= NormSearch(with_history(system, 3)).improve(0.0).upper
    n = system.dimension
    forms = np.eye(n) + 0.5 * rng.normal(size=(system.graph.nodes, n, n))
    for transformed in (norms.system, system.in_coordinates(forms)):
        assert transformed is not None
        for growth in (0.5 * bounds.lower, 1.01 * bounds.lower):
            assert bound_by_products(transformed, growth, 300).upper >= bounds.lower
    zero = [step._replace(matrix=exactly(0 * step.matrix.middle)) if number in bounds.cycle else step
            for number, step in enumerate(edges)]  # fmt: skip
    assert NormSearch(SwitchedSystem.of(zero)).improve(0.0).upper < bounds.lower


@pytest.mark.parametrize("seed", range(10))
def test_spectral_radius_bounds_hold_for_every_matrix_of_an_enclosure(seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 7))
    middle = rng.normal(size=(n, n))
    sharp, above = spectral_radius_bounds(exactly(middle))
    assert sharp == pytest.approx(np.abs(np.linalg.eigvals(middle)).max(), rel=1e-8)
    assert sharp <= above <= sharp * (1 + 1e-9)
    radius = rng.uniform(0, 1e-4, (n, n))
    below, above = spectral_radius_bounds(IntervalMatrix(middle, radius))
    ends = [middle + radius * rng.choice([-1, 1], (n, n)) for _ in range(200)]
    radii = [np.abs(np.linalg.eigvals(end)).max() for end in ends]
    assert 0.9 * sharp < below <= min(radii)
    assert max(radii) <= above < 1.1 * sharp


@pytest.mark.parametrize("seed", range(10))
def test_a_graph_with_one_cycle_is_decided(seed: int) -> None:
    """One matrix, or a ring of up to three, whose spectral radius is 3e-4 below 1, or above it."""
    rng = np.random.default_rng(seed)
    length, n, value = int(rng.integers(1, 4)), int(rng.integers(1, 7)), 1 + 3e-4 * (-1) ** seed
    matrices = rng.normal(size=(length, n, n))
    Π = np.linalg.multi_dot([np.eye(n), np.eye(n), *matrices[::-1]])
    matrices *= value / np.abs(np.linalg.eigvals(Π)).max() ** (1 / length)
    edges = [edge(k, (k + 1) % length, matrix) for k, matrix in enumerate(matrices)]
    bounds = joint_spectral_radius(edges)
    assert bounds.lower <= bounds.upper <= bounds.lower * (1 + 1e-9)
    assert bounds.lower == pytest.approx(value, rel=1e-9)
    assert sorted(bounds.cycle) == list(range(length))


def test_nilpotent_systems_do_not_grow() -> None:
    shift = np.diag([1.0, 1.0], k=1)
    bounds = joint_spectral_radius([edge(0, 0, shift), edge(0, 0, 2 * shift)])
    assert bounds.lower == 0
    assert bounds.upper < 0.01


def test_maps_that_are_zero_have_norms_near_0() -> None:
    zeros = SwitchedSystem.of([edge(0, 0, np.zeros((2, 2))), edge(0, 0, np.zeros((2, 2)), 2)])
    assert NormSearch(zeros).improve(1.0).growths.max() < 1e-70


def test_sizes_beyond_the_range_of_doubles_prove_nothing_false() -> None:
    zero = joint_spectral_radius([edge(0, 0, [[0.0]]), edge(0, 0, [[0.0]], 3)], threshold=1.0)
    assert (zero.lower, zero.cycle) == (0, ())
    assert zero.upper < 1e-90
    turn = np.array([[0.0, 1e300], [1e-300, 0.0]])
    with np.errstate(all="ignore"):
        bounds = joint_spectral_radius([edge(0, 0, turn), edge(0, 0, 0.9 * np.eye(2))])
    assert bounds.lower == pytest.approx(1)
    assert bounds.upper >= 1


def test_edges_that_are_on_no_cycle_do_not_count() -> None:
    edges = [edge(0, 0, [[0.5]]), edge(0, 1, [[100.0]]), edge(1, 2, [[100.0]])]
    assert joint_spectral_radius(edges).upper < 0.51


def test_a_nilpotent_or_defective_cycle_is_bounded_tightly() -> None:
    nilpotent = joint_spectral_radius([edge(0, 0, np.diag([1e-3, 1e3], k=1))])
    assert (nilpotent.lower, nilpotent.cycle) == (0, ())
    assert 0 < nilpotent.upper < 1e-9
    defective = joint_spectral_radius([edge(0, 0, [[0.7, 1e5, 3], [0, 0.7, 1e5], [0, 0, 0.7]])])
    assert defective.lower <= 0.7 <= defective.upper < 0.7 * (1 + 1e-9)
