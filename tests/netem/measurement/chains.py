"""Simulated packet traces with known parameters."""

import numpy as np
from numpy.typing import NDArray

from netem.measurement.chain_fits import ChainRates
from netem.traces.packet_trace import PacketTrace, packet_trace

PERIOD_NS = 20_000_000
GILBERT = ChainRates(0.02, 0.2, 0.0, 1.0)
ELLIOTT = ChainRates(0.02, 0.1, 0.01, 0.6)


def chain_losses(count: int, rates: ChainRates, seed: int) -> NDArray[np.bool_]:
    """Draw the losses of a stationary chain, (count,), state by state."""
    rng = np.random.default_rng(seed)
    moves, losses = rng.random(count), rng.random(count)
    bad, lost = rng.random() < rates.share_bad, np.zeros(count, bool)
    for k in range(count):
        bad = moves[k] >= rates.bad_to_good if bad else moves[k] < rates.good_to_bad
        lost[k] = losses[k] < (rates.loss_in_bad if bad else rates.loss_in_good)
    return lost


def trace_of(lost: NDArray[np.bool_], delay_ns: int = 1_000_000) -> PacketTrace:
    """Return a trace with these losses, at 50 Hz, and a constant delay."""
    sent_ns = PERIOD_NS * np.arange(len(lost))
    return packet_trace(sent_ns, sent_ns + delay_ns, lost)
