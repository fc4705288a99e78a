"""Delay: a constant, and a random part drawn by the quantile of a uniform number.

Random parts have mean 0: uniform within ± jitter; normal, Pareto (shape 3) and their mixture with
the jitter as standard deviation; empirical ones are drawn between the observed values.
"""

import math
from collections.abc import Sequence

from netem.rule_records import DelaySettings, FlowState, StageMemory
from netem.rules.correlated_chance import latent
from netem.rules.normal import cdf, score

UNIFORM = 0
NORMAL = 1
PARETO = 2
PARETONORMAL = 3
EMPIRICAL = 4

_PARETO_MEAN = 1.5
_PARETO_DEVIATION = 0.8660254037844386
"""Mean 3/2 and variance 3/4 of the Pareto distribution with shape 3 and scale 1."""
_MIXED_DEVIATION = 0.937753856873566
"""Of N/4 + 3P/4 with quantiles N normal and P Pareto: √(5/8 + 3/8 E NP), E NP = 0.678352789549…"""
_LONGEST_NS = 1e15
"""11.6 days; the Pareto distribution has no end, and integers have."""


def pareto(u: float) -> float:
    """Quantile of the Pareto distribution with shape 3, mean 0 and standard deviation 1."""
    return (math.pow(1.0 - u, -1.0 / 3.0) - _PARETO_MEAN) / _PARETO_DEVIATION


def quantile_ns(wait: DelaySettings, table_ns: Sequence[float], u: float) -> float:
    """Quantile of the random part, in ns; ``u`` in [0, 1)."""
    if wait.shape == NORMAL:
        return wait.jitter_ns * score(u)
    if wait.shape == PARETO:
        return wait.jitter_ns * pareto(u)
    if wait.shape == PARETONORMAL:
        return wait.jitter_ns * (0.25 * score(u) + 0.75 * pareto(u)) / _MIXED_DEVIATION
    if wait.shape == EMPIRICAL:
        place = u * (wait.end - wait.begin - 1)
        knot = min(int(place), wait.end - wait.begin - 2)
        low, high = table_ns[wait.begin + knot], table_ns[wait.begin + knot + 1]
        return low + (high - low) * (place - knot)
    return wait.jitter_ns * (2.0 * u - 1.0)


def delay_ns(
    wait: DelaySettings, table_ns: Sequence[float], memory: StageMemory, flow: FlowState, u: float
) -> int:
    """Draw a delay, in whole ns; ``u`` is a uniform number.

    A correlated one goes through normal scores, which keeps its distribution: with ρ the
    correlation with bad times of score s, z = ρ s + √(1 − ρ²) z', and the quantile is Φ(z)'s.
    """
    if wait.correlation != 0.0 or wait.loss_correlation != 0.0:
        z = latent(wait.correlation, wait.innovation, memory, u)
        if wait.loss_correlation != 0.0:
            z = wait.loss_correlation * flow.score + wait.loss_innovation * z
        u = min(cdf(z), 0.9999999999999999)
    return int(min(max(wait.constant_ns + quantile_ns(wait, table_ns, u), 0.0), _LONGEST_NS))
