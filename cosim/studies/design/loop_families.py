"""The gains and norms among which a design chooses."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cosim.studies.design.design_space import MOST_RATE, RATE_STEP, decay_rate, with_gain, with_norm
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.theory.bounds.enclosure import NotDecayingError
from noack.theory.bounds.terms import NetworkConditions
from noack.theory.certificates.weight import choose_weight

NORMS = ("identity", "given", "chosen")
COSTS_OF_INPUT = (0.1, 1.0, 10.0)
"""Factors of R: three regulators, from large to small inputs."""
_LEVEL = 0.1


def families_of(
    scenario: Scenario,
    norms: Sequence[str],
    lqr: tuple[Matrix, Matrix] | None,
    progress: Callable[[float], None] = lambda share: None,
) -> dict[tuple[str, str], Scenario]:
    """Return scenarios by the names of gain and norm.

    With ``lqr`` (Q and R) the gains are those of regulators, one for each of
    :data:`COSTS_OF_INPUT`; otherwise the gain is the scenario's. Computing a norm takes long.

    Raises:
        CallerError: a norm or a gain cannot be computed.
    """
    if not norms:
        raise CallerError(f"--weights: name one at least of {', '.join(NORMS)}")
    gains = {"given": scenario} if lqr is None else dict(_regulated(scenario, *lqr))
    found = {}
    for i, (gain, one) in enumerate(gains.items()):

        def report(share: float, done: int = i) -> None:
            progress((done + share) / len(gains))

        for norm in norms:
            found[gain, norm] = _normed(one, norm, report)
    return found


def _regulated(scenario: Scenario, Q: Matrix, R: Matrix) -> list[tuple[str, Scenario]]:
    loop = loop_of(resolve(scenario))
    for name, matrix, size in (("--Q", Q, loop.n), ("--R", R, loop.m)):
        if matrix.shape != (size, size):
            raise CallerError(
                f"{name}: expected {size} x {size}, or {size} numbers for its diagonal"
            )
    found = []
    for cost in COSTS_OF_INPUT:
        K = lqr_gain(loop.A_model, loop.B_model, Q, cost * R)
        found.append((f"lqr R × {cost:g}", with_gain(scenario, K)))
    return found


def lqr_gain(A: Matrix, B: Matrix, Q: Matrix, R: Matrix) -> Matrix:
    """Return K of u = K x, (m, n): K = −R⁻¹BᵀP, AᵀP + PA − PBR⁻¹BᵀP + Q = 0.

    Raises:
        CallerError: Q or R is not a valid weight, or no P makes the loop stable.
    """
    from scipy.linalg import solve_continuous_are

    for name, matrix, least in (("--Q", Q, "semidefinite"), ("--R", R, "definite")):
        if not np.allclose(matrix, matrix.T, rtol=1e-12, atol=0.0):
            raise CallerError(f"{name}: must be symmetric")
        smallest = np.linalg.eigvalsh(matrix)[0]
        if smallest < -1e-12 * np.abs(matrix).max() or (least == "definite" and smallest <= 0):
            raise CallerError(f"{name}: must be positive {least}")
    try:
        P = solve_continuous_are(A, B, Q, R)
    except np.linalg.LinAlgError:
        raise CallerError(
            "--gain lqr: the Riccati equation of this model has no stabilising solution; "
            "every unstable mode must be within the inputs' reach and weighed by Q"
        ) from None
    return np.asarray(-np.linalg.solve(R, B.T @ P), dtype=np.float64)


def _normed(scenario: Scenario, norm: str, progress: Callable[[float], None]) -> Scenario:
    if norm == "identity":
        return with_norm(scenario, None)
    if norm == "given":
        if scenario.decaying.weight is None:
            raise CallerError("--weights given: the scenario has no trigger.weight")
        return scenario
    if norm != "chosen":
        raise CallerError(f'--weights: {", ".join(NORMS)}, not "{norm}"')
    if scenario.mode == "zoh":
        raise CallerError(
            "--weights chosen: models that hold do not decay; take --weights identity"
        )
    loop = loop_of(resolve(scenario))
    nominal = replace(loop, A=loop.A_model, B=loop.B_model)
    # α in the middle of the grid: a norm that contracts at this rate does so at all lower rates.
    alpha_per_s = MOST_RATE * decay_rate(scenario) / RATE_STEP
    beta = _LEVEL * float(np.linalg.norm(loop.x0))
    try:
        conditions = NetworkConditions(scenario.network.longest_burst)
        weight = choose_weight(nominal, beta, alpha_per_s, conditions, progress)
    except NotDecayingError as error:
        raise CallerError(f"--weights chosen: {error}") from None
    return with_norm(scenario, weight)
