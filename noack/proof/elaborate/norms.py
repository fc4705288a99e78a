"""Norms of matrix exponentials, enclosed: the growth of errors between two tests, and the paper's chain."""

from flint import arb, arb_mat

from noack.core.balls import identity, is_positive, square, upto

_CELLS = 64
_MOST_CELLS = 20_000
_SQUARINGS = 14


def spectral_norm(M: arb_mat, squarings: int = _SQUARINGS) -> arb:
    """Return an upper bound of ‖M‖₂: the root of trace((MᵀM)^k)^(1/k), k = 2^squarings."""
    power = square(M)
    for _ in range(squarings):
        power = power * power
    trace = sum((power[i, i] for i in range(power.nrows())), arb(0))
    return arb(trace.abs_upper()).root(2 ** (squarings + 1))


def growth(G: arb_mat, until: arb) -> tuple[arb, arb]:
    """Return upper bounds of sup ‖e^{Gs}‖ and of ∫ ‖e^{Gs}‖ ds over 0 ≤ s ≤ ``until``."""
    largest, total, step = arb(1), arb(0), until / _CELLS
    within = (upto(step) * G).exp()
    edge = identity(G.nrows())
    forward = (step * G).exp()
    for _ in range(_CELLS):
        norm = spectral_norm(edge * within)
        largest, total = largest.max(norm), total + step * norm
        edge = edge * forward
    return arb(largest.abs_upper()), arb(total.abs_upper())


def lyapunov_function(F: arb_mat, Q: arb_mat) -> arb_mat | None:
    """Return P ≻ 0 with FᵀP + PF = −Q, (n, n); None if it is not proven that there is one."""
    n = F.nrows()
    every = [(i, j) for i in range(n) for j in range(n)]
    equations = arb_mat(
        n * n,
        n * n,
        [F[k, i] * (j == m) + F[m, j] * (i == k) for i, j in every for k, m in every],
    )
    try:
        solution = equations.solve(arb_mat(n * n, 1, [-Q[i, j] for i, j in every]))
    except ZeroDivisionError:
        return None
    P = arb_mat(n, n, [(solution[i * n + j, 0] + solution[j * n + i, 0]) / 2 for i, j in every])
    return P if is_positive(P) else None
