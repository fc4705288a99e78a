"""Something that happens with a probability, to successive datagrams alike if correlated.

The latent variable z_i = ρ z_{i−1} + √(1 − ρ²) g_i is a stationary Gaussian process, and something
happens when z_i exceeds the normal quantile of 1 − p: with probability p exactly, whatever ρ is.
"""

from netem.rule_records import ChanceSettings, StageMemory
from netem.rules.normal import score


def latent(correlation: float, innovation: float, memory: StageMemory, u: float) -> float:
    """Advance a latent process by one datagram and return z, standard normal.

    Args:
        correlation: ρ.
        innovation: √(1 − ρ²).
        memory: of the flow.
        u: a uniform number.
    """
    z = -score(u)
    if correlation != 0.0:
        if memory.phase != 0:
            z = correlation * memory.score + innovation * z
        memory.phase = 1
        memory.score = z
    return z


def happens(chance: ChanceSettings, memory: StageMemory, u: float) -> bool:
    """Whether it happens to the next datagram; ``u`` is a uniform number."""
    if chance.correlation == 0.0:
        return u < chance.probability
    z = latent(chance.correlation, chance.innovation, memory, u)
    return z > chance.threshold
