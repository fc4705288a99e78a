"""Upper bound on the contribution of the rest of a run to ∫‖x‖².

From x' = (A+BK) x + B p, p = K e_c, and the triangle inequality in L₂[t, ∞),

    ‖x‖_{L₂} ≤ √(x(t)ᵀ P x(t)) + ∫₀^∞‖e^{(A+BK)s}B U‖ds · ‖p‖_{L₂},  (A+BK)ᵀP + P(A+BK) = −I

by Young's inequality for the convolution, with K = U R. By identity (I1) every pattern has
‖R e_c‖ ≤ D level(t): D sums the gains of the present e_s and of the longest burst of missed ones,
at any distance.
The bound is cheap and prunes the late part of the search tree. There is no comparable bound for
suprema: they may occur at any time, and a bound from growth rates prunes only the last fraction of
a second.
"""

import numpy as np

from cosim.analysis.adversary.objective import weight_of
from cosim.analysis.adversary.pattern_tree import Ceiling
from cosim.analysis.adversary.search_nodes import Nodes
from cosim.simulation.continuous import ContinuousLoop
from noack.core.linear_systems import Vector
from noack.theory.bounds.enclosure import NotDecayingError, response
from noack.theory.bounds.gains import ErrorGains, Output


def cost_ceiling(
    system: ContinuousLoop, longest_burst: int | None, horizon_s: float
) -> Ceiling | None:
    """Return the bound for a loop; None if A + BK is not stable, or bursts may be of any length."""
    from scipy.linalg import solve_continuous_lyapunov

    if longest_burst is None:
        return None
    loop, trigger = system.loop, system.decaying
    closed = loop.A + loop.B @ loop.K
    models = _models(system)
    missing = models.now(Output.GAIN) + models.missing(Output.GAIN, longest_burst, 0.0)
    try:
        pushed = response(closed, loop.B @ models.split_K[0])
    except NotDecayingError:
        return None
    gain = pushed.through(np.eye(loop.n)).integral() * missing
    P = solve_continuous_lyapunov(closed.T, -np.eye(loop.n))
    rate, beta = 2 * models.alpha_per_s, trigger.beta

    def ceiling(nodes: Nodes) -> Vector:
        x, rest_s = nodes.z[:, : loop.n], horizon_s - nodes.t_s
        own = np.einsum("ai,ij,aj->a", x, P, x)
        faded = -np.expm1(-rate * rest_s) / rate if rate else rest_s
        level = beta**2 * np.exp(-rate * nodes.t_s) * faded + trigger.floor**2 * rest_s
        return np.asarray((np.sqrt(own) + gain * np.sqrt(level)) ** 2)

    return ceiling


def _models(system: ContinuousLoop) -> ErrorGains:
    """Return the gains at the threshold's rate if the models decay faster, otherwise at rate 0."""
    loop, weight = system.loop, weight_of(system)
    gains = ErrorGains(loop.H, loop.K, weight, system.decaying.alpha_per_s)
    try:
        gains.missing(Output.GAIN, 1, 0.0)
    except NotDecayingError:
        return ErrorGains(loop.H, loop.K, weight, 0.0)
    return gains
