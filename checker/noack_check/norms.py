"""Norms of matrix exponentials, enclosed: the growth of errors between two tests, and the paper's chain."""

from flint import arb, arb_mat

from noack_check.balls import frobenius, identity, is_positive, square, transpose, upto

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


def decays_below(G: arb_mat, bound: arb, tail: arb_mat) -> bool:
    """Return whether ‖e^{Gτ}‖ ≤ ``bound`` is proven for all τ ≥ 0.

    ``tail`` is a P ≻ 0 with GᵀP + PG ≺ 0, so ‖e^{Gs}‖ ≤ c, c² = λmax(P)/λmin(P), for all s: from the
    time on at which c‖e^{Gτ}‖ ≤ ``bound``, nothing is left to show. Before it, on each cell of length s,
    e^{G(τ+r)} lies within s²/8 · sup‖G² e^{G(τ+r)}‖ of its chord.
    """
    n = G.nrows()
    if not (is_positive(tail) and is_positive(-1 * (transpose(G) * tail + tail * G))):
        return False
    try:
        high, low = spectral_norm(tail), 1 / spectral_norm(tail.inv())
    except ZeroDivisionError:
        return False
    constant = arb((high / low).sqrt().abs_upper())
    edge, time, step = identity(n), arb(0), arb(1) / (4 * spectral_norm(G) + arb(2) ** -40)
    for _ in range(_MOST_CELLS):
        if constant * spectral_norm(edge) <= bound:
            return True
        step = arb(step.mid())
        following = ((time + step) * G).exp()
        curved = step**2 / 8 * frobenius(G * G * (upto(step) * G).exp() * edge)
        if spectral_norm(edge).max(spectral_norm(following)) + curved <= bound:
            edge, time, step = following, time + step, step * 13 / 10
        else:
            step = step / 2
            if step < arb(2) ** -30:
                return False
    return False


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
