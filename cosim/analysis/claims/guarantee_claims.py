"""The network's guarantee as a claim about a run: each of its rules, checked for all updates.

A rule counts the losses among the updates that reached the network, in their order. A setting that changes
the guarantee ends the claim.
"""

import math

import numpy as np

from cosim.analysis.summary.summary_model import Claim, ClaimKind, ClaimVerdict
from cosim.record.run_events import changes_of, packet_outcomes
from cosim.record.run_record import RunRecord
from netem.core.clock import NS_PER_S
from netem.guarantee.loss_guarantee import LossRule


def guarantee_claims(record: RunRecord) -> list[Claim]:
    """Return for each rule of the guarantee whether the network kept it; none if nothing was sent."""
    guarantee, outcomes = record.scenario.network.guarantee, packet_outcomes(record)
    changed_ns = [
        change.first_ns for change in changes_of(record) if change.scenario.network.guarantee != guarantee
    ]
    until_s = min(changed_ns) / NS_PER_S if changed_ns else math.inf
    t_s = outcomes.event_ns / NS_PER_S
    claimed = t_s < until_s
    if not claimed.any():
        return []
    lost = outcomes.lost[claimed].tolist()
    return [_claim(rule, lost, t_s[claimed].tolist(), until_s) for rule in guarantee.rules]


def _claim(rule: LossRule, lost: list[bool], t_s: list[float], until_s: float) -> Claim:
    values, state = list[int](), rule.start
    for is_lost in lost:
        state, value = rule.after(state, is_lost)
        values.append(value)
    broken = np.flatnonzero(np.array(values) > rule.limit)
    largest = max(values)
    return Claim(
        what=rule.meaning, kind=ClaimKind.GUARANTEE, source="network", bound=rule.meaning,
        certified=float(rule.limit), observed=float(largest),
        ratio=largest / rule.limit if rule.limit else None,
        verdict=ClaimVerdict.VIOLATED if len(broken) else ClaimVerdict.HELD,
        since_s=t_s[broken[0]] if len(broken) else None,
        until_s=round(until_s, 9) if math.isfinite(until_s) else None, quantity="losses",
    )  # fmt: skip
