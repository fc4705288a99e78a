"""Decisions of the link without sockets, and an independent check of the loss bursts."""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks._relay_load import DATAGRAM_BYTES
from netem.engine.compiled_rules import compile_rule, compiled_program, compiled_state, set_flow
from netem.engine.many_decisions import admit_many
from netem.link_machine import Link
from netem.rule_program import program_of
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_records import PacketDecision, dtype_of
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.protocol.record_tables import Fate

LOSS = 0.5
MANSD = 4
SEED = 7
_SETTINGS = LinkSettings(impairments=(LossOf(loss=BernoulliLoss(probability=LOSS)),), mansd=MANSD)

Fates = npt.NDArray[np.uint8]
Decide = Callable[[int], Fates]
"""Decides for the next n datagrams of each flow, the flows in turn; returns fates (n, flows)."""

_DELIVERED = np.zeros(256, bool)
_DELIVERED[[Fate.DELIVERED, Fate.FORCED]] = True


class LossRuns:
    """Consecutive losses of each flow, counted from fates only.

    Args:
        flows: number of flows.
    """

    def __init__(self, flows: int) -> None:
        self._runs = np.zeros(flows, np.int64)
        self.longest = 0
        self.lost = 0
        self.decisions = 0

    def add(self, fates: Fates) -> None:
        """Add the next fates of each flow, (n, flows)."""
        for row in ~_DELIVERED[fates]:
            self._runs = (self._runs + 1) * row
            self.longest = max(self.longest, int(self._runs.max()))
            self.lost += int(np.count_nonzero(row))
        self.decisions += fates.size


def predicted_loss(probability: float, mansd: int) -> float:
    """Return the loss rate of independent losses, at most ``mansd`` of them consecutive.

    A cycle ends with a delivery. It has k losses with probability p^k (1 − p) for k < m, and m
    losses with probability p^m, so that E[losses] / E[length] = p (1 − p^m) / (1 − p^(m+1)).
    """
    return probability * (1 - probability**mansd) / (1 - probability ** (mansd + 1))


def plain(flows: int) -> Decide:
    """Return the rules in plain Python, as simulation and replay run them."""
    link = Link(_SETTINGS, SEED, "relay", "forward")

    def decide(count: int) -> Fates:
        fates = np.empty((count, flows), np.uint8)
        for row in fates:
            for flow in range(flows):
                row[flow] = link.decide(flow, DATAGRAM_BYTES, 0).fate
        return fates

    return decide


def compiled(flows: int) -> Decide:
    """Return the compiled rules, as the fast relay runs them, one batch per call."""
    admit_compiled = compile_rule(admit_many)
    program = program_of(_SETTINGS, SEED, "relay", "forward")
    state = compiled_state(program, flows)
    for flow in range(flows):
        set_flow(state, flow, flow, _SETTINGS.first_delivered)
    program = compiled_program(program)

    @functools.cache
    def batch(count: int) -> tuple[npt.NDArray[Any], ...]:
        n = count * flows
        sizes_bytes, arrivals_ns = np.full(n, DATAGRAM_BYTES), np.zeros(n, np.int64)
        verdicts = np.zeros(n, dtype_of(PacketDecision))
        return np.tile(np.arange(flows), count), sizes_bytes, arrivals_ns, verdicts

    def decide(count: int) -> Fates:
        arrays = batch(count)
        admit_compiled(program, state, *arrays)
        return arrays[-1]["fate"].astype(np.uint8).reshape(count, flows)

    return decide
