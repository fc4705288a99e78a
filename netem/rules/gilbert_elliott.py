"""Bursty losses: a two-state Markov chain (Gilbert, 1960; Elliott, 1963).

The chain starts in the good state and may change its state before each datagram: good → bad with
probability p, bad → good with probability r. A datagram is lost with probability 1 − k in the good
state and 1 − h in the bad. In the stationary chain the loss rate is

    (1 − k) r/(p + r) + (1 − h) p/(p + r).
"""

from netem.rule_records import FlowState, GilbertElliottSettings, StageMemory
from netem.rules.normal import score

GOOD = 0
BAD = 1


def lost(
    chain: GilbertElliottSettings,
    memory: StageMemory,
    flow: FlowState,
    u: float,
    v: float,
    w: float,
    scored: bool,
) -> bool:
    """Whether the next datagram would be lost; u, v and w are uniform numbers.

    With ``scored`` the flow learns how bad its times are: a datagram in the bad state is among the
    worst p/(p + r).
    """
    if memory.phase == BAD:
        if u < chain.bad_to_good:
            memory.phase = GOOD
    elif u < chain.good_to_bad:
        memory.phase = BAD
    if scored:
        bad = chain.share_bad
        flow.score = -score(w * bad if memory.phase == BAD else bad + w * (1.0 - bad))
    return v < (chain.loss_in_bad if memory.phase == BAD else chain.loss_in_good)
