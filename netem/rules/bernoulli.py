"""Bernoulli losses: each datagram is lost with a probability, independently unless correlated."""

from netem.rule_records import ChanceSettings, FlowState, StageMemory
from netem.rules.correlated_chance import happens
from netem.rules.normal import score


def lost(
    chance: ChanceSettings, memory: StageMemory, flow: FlowState, u: float, scored: bool
) -> bool:
    """Whether the next datagram would be lost; ``u`` is a uniform number.

    With ``scored`` the flow learns how bad its times are.
    """
    is_lost = happens(chance, memory, u)
    if scored:
        flow.score = -score(u) if chance.correlation == 0.0 else memory.score
    return is_lost
