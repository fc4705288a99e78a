"""The published results: every one is reproduced, but for rows whose deviation is known."""

from collections.abc import Sequence
from io import StringIO

import numpy as np
import pytest
from rich.console import Console
from scipy.linalg import solve_discrete_are
from scipy.optimize import minimize

from cosim.studies.paper.published_result import print_rows, stored_matrices
from cosim.studies.paper.results import NAMES, demirel, reproduce, selivanov_fridman, umsonst_barbosa
from tests.helpers.pages import ROOT

PAGE = (ROOT / "docs/published.md").read_text()


@pytest.mark.parametrize("name", NAMES)
def test_rows_are_as_published_and_as_documented(name: str) -> None:
    reproduction = reproduce(name)
    for row, cells in zip(reproduction.rows, reproduction.table.rows, strict=True):
        assert row.as_expected, row
        assert f"| {' | '.join(cells)} |" in PAGE
        assert row.verdict == ("reproduced" if row.relation == "=" else "agrees") or row.deviation
    assert reproduction.result.about in PAGE
    output = StringIO()
    print_rows(Console(file=output, width=80), reproduction)
    lines = output.getvalue().splitlines()
    verdicts = sum(line.endswith(("reproduced ", "agrees ", "differs ")) for line in lines)
    assert verdicts == len(reproduction.rows)


def formula(loop: demirel.ScheduledLoop, sent: Sequence[bool]) -> float:
    """The authors' formula of the loss, by the steps since the last transmission."""
    A, L, C = loop.A, loop.gain, loop.C
    S = solve_discrete_are(A, loop.B, loop.Q, loop.R)
    P = solve_discrete_are(A.T, C.T, loop.W, loop.V)
    M, corrected = L.T @ (loop.B.T @ S @ loop.B + loop.R) @ L, loop.filter_gain @ C @ P
    errors, error = [], np.zeros_like(A)
    for arrives in [*sent, *sent]:
        error = np.zeros_like(A) if arrives else A @ error @ A.T + corrected
        errors.append(error)
    mean = np.mean(errors[len(sent) :], axis=0)
    return float(np.trace(S @ loop.W) + np.trace(M @ (P - corrected + mean)))


@pytest.mark.parametrize("seed", range(5))
def test_losses_agree_with_the_authors_formula(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for loop in demirel.drawn_loops(seed + 20):
        sent = [True, *(rng.random(6) < 0.4)]
        assert loop.mean_cost(sent) == pytest.approx(formula(loop, sent), rel=1e-8)


def test_the_row_that_differs_is_not_what_the_authors_formula_gives_either() -> None:
    turns = list("2131211")
    loops = zip("123", demirel.drawn_loops(), strict=True)
    total = sum(formula(loop, [turn == own for turn in turns]) for own, loop in loops)
    assert total == pytest.approx(380.4944, abs=5e-5)


def margin(statement: str, solution: selivanov_fridman.Solution, h: float, epsilon: float) -> float:
    inequalities, _, _, waits = selivanov_fridman.INEQUALITIES[statement]
    parts = inequalities(solution, h, epsilon, waits=waits)
    return min(map(selivanov_fridman.smallest_eigenvalue, parts))


def test_a_broken_solution_is_no_solution() -> None:
    """Beyond the published h and ε the stored solutions fail, and so do changed ones."""
    for statement, (_, h, epsilon, _) in selivanov_fridman.INEQUALITIES.items():
        solution = stored_matrices("selivanov_fridman")[statement]
        assert margin(statement, solution, h, epsilon) > 1e-9
        assert margin(statement, solution, 1.02 * h, epsilon) < 0
        assert margin(statement, solution, h, 1.05 * epsilon) < 0
        for name in solution:
            assert margin(statement, {**solution, name: -solution[name]}, h, epsilon) < 0, name


def test_the_scaled_eigenvalue_is_that_of_the_matrix() -> None:
    corner, square = np.array([[4.0]]), np.array([[1.0, 0.0], [0.0, 9.0]])
    blocks = {(1, 1): corner, (1, 2): np.array([[0.0, 3.0]]), (2, 2): square}
    matrix = selivanov_fridman.symmetric(blocks)
    assert selivanov_fridman.smallest_eigenvalue(matrix) == pytest.approx(0.5)  # 1 − 3/√(4·9)
    assert selivanov_fridman.smallest_eigenvalue(-corner) < 0


@pytest.fixture(scope="module")
def optimisation() -> umsonst_barbosa.Optimisation:
    return umsonst_barbosa.optimised()[0]


def test_predicted_inputs_are_the_best_within_the_limits(optimisation: umsonst_barbosa.Optimisation) -> None:
    """Against another solver, with the cost and the limits written out step by step."""
    plant, N = optimisation.plant, umsonst_barbosa.N
    most = plant.most_x - [plant.tube(optimisation.K, unit) for unit in np.eye(4)]
    most_u = plant.most_u - plant.tube(optimisation.K, optimisation.K[0])

    def states(v: np.ndarray, start: np.ndarray) -> np.ndarray:
        z = [start]
        for u in v[:N]:
            z.append(plant.A @ z[-1] + plant.B[:, 0] * u)
        return np.array(z)

    def room(v: np.ndarray, start: np.ndarray) -> np.ndarray:
        return np.append(np.ravel(most - np.abs(states(v, start)[1:])), most_u - np.abs(v[:N]))

    def cost(v: np.ndarray, start: np.ndarray) -> float:
        off = states(v, start) - v[N] * np.eye(4)[0]
        steps = np.einsum("ki,ij,kj", off[:-1], plant.Q, off[:-1]) + plant.R[0, 0] * v[:N] @ v[:N]
        target = 10 * optimisation.P[0, 0] * (v[N] - umsonst_barbosa.TARGET_M) ** 2
        return float(steps + off[-1] @ optimisation.P @ off[-1] + target)

    for start in (np.zeros(4), np.array([0.2, 0.3, -0.02, 0.1]), np.array([0.4, 0.0, 0.05, -0.3])):
        solution = optimisation.inputs(start)
        assert solution is not None
        predicted = np.append(*solution)
        assert room(predicted, start).min() > -1e-9
        limits = {"type": "ineq", "fun": room, "args": (start,)}
        by_other_solver = minimize(
            cost, np.zeros(N + 1), (start,), "SLSQP", constraints=limits, options={"ftol": 1e-12}
        )
        assert cost(predicted, start) <= by_other_solver.fun * (1 + 1e-6)
    assert optimisation.inputs(np.array([0.0, 0.0, 0.07, 1.1])) is None


def test_without_the_gain_at_the_plants_side_the_tube_is_left(
    optimisation: umsonst_barbosa.Optimisation,
) -> None:
    drawn, worst = umsonst_barbosa.make_disturbances(optimisation)
    own = optimisation.K[0]
    assert umsonst_barbosa.run(optimisation, 0.5, drawn, own).tube < 1
    assert umsonst_barbosa.run(optimisation, 0.5, drawn, 0 * own).tube > 1
    assert umsonst_barbosa.run(optimisation, 0.5, 1.01 * worst, own).tube == pytest.approx(1.01, rel=1e-4)


def test_the_plant_is_farther_from_the_target_than_the_nominal_position(
    optimisation: umsonst_barbosa.Optimisation,
) -> None:
    farthest_m = max(outcome.plant_distance_m for outcome in umsonst_barbosa.optimised()[1])
    reach_m = optimisation.plant.tube(optimisation.K, np.eye(4)[0])
    for metres in (farthest_m, reach_m):
        assert f"{1000 * metres:.0f} mm" in umsonst_barbosa.RESULT.notes[1]
