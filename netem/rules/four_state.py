"""Bursty losses with isolated ones: a Markov chain of four states (Salsano, Ludovici & Ordine).

1 gap: delivered. 2: delivered within a burst. 3: lost within a burst. 4: a single loss in a gap.
From 4 the chain returns to 1. It starts in 1 and moves before each datagram.
"""

from netem.rule_records import FourStateSettings, StageMemory


def lost(chain: FourStateSettings, memory: StageMemory, u: float) -> bool:
    """Whether the next datagram would be lost; ``u`` is a uniform number."""
    state = memory.phase + 1
    if state == 1:
        if u < chain.p13:
            state = 3
        elif u < chain.p13 + chain.p14:
            state = 4
    elif state == 2:
        if u < chain.p23:
            state = 3
    elif state == 3:
        if u < chain.p31:
            state = 1
        elif u < chain.p31 + chain.p32:
            state = 2
    else:
        state = 1
    memory.phase = state - 1
    return state >= 3
