"""The trigger policies besides the paper's: the loops are drawn and simulated as for ``decaying``.

The rules are written again in ``tests/noack/theory/event_rules.py``.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

from noack.config.scenario import Scenario
from noack.theory.bounds.terms import NetworkConditions
from noack.theory.certificates.certified_bounds import ScenarioCertificate
from noack.theory.certificates.scenario_certificates import certify
from tests.noack.theory import policy_loops
from tests.noack.theory.broken_policies import BROKEN_POLICIES
from tests.noack.theory.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificate_kinds.decaying import search
from tests.noack.theory.certificate_kinds.shares import Case, shares_of
from tests.noack.theory.loops import Flags, Steps, System, Trace, random_system, simulate

_Certify = Callable[[Scenario, NetworkConditions], ScenarioCertificate]


def _draw(kind: str, where: dict[str, Any], rng: np.random.Generator) -> Case:
    if not where and rng.uniform() < 0.5:
        where = {"step_share": 0.002}
    system = random_system(rng, **where)
    return Case(policy_loops.policy_case(kind, system, int(rng.integers(2**32))))


def _bounds(certify: _Certify) -> Callable[[Case], Bounds | None]:
    def certified(case: Case) -> ScenarioCertificate | None:
        resolved, _, system = case.loop
        found = certify(resolved, system.conditions)
        return None if found.constants is None else found

    return shares_of(("e_s", "e_c", "x", "1/δ"), certified)


def _simulate(case: Case, rng: np.random.Generator) -> Observed:
    """Search for losses that exceed the certificate."""
    _, rule, drawn = case.loop

    def run(system: System, outcomes: Flags, delays: Steps) -> Trace:
        return simulate(system, outcomes, delays, rule=rule)

    def worst(system: System, trace: Trace) -> dict[str, float]:
        return policy_loops.shares_of(trace, case.found, system)

    return search(drawn, rng, run, worst)


def _kinds() -> Iterable[Kind]:
    for kind in policy_loops.KINDS:
        broken = {
            mistake.removeprefix(f"{kind}, "): Broken(_bounds(wrong), partial(_draw, kind, where))
            for mistake, (policy, wrong, where) in BROKEN_POLICIES.items()
            if policy == kind
        }
        yield Kind(kind, partial(_draw, kind, {}), _bounds(certify), _simulate, broken)


POLICIES = tuple(_kinds())
