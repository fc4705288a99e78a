"""The trigger policies besides the paper's: the loops are drawn and simulated as for ``decaying``.

The rules are written again in ``tests/noack/theory/event_rules.py``.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

import numpy as np

from benchmarks._certificate_kinds import Bounds, Broken, Kind, Observed
from benchmarks._certificate_kinds.decaying import search
from noack.config.scenario import Scenario
from noack.theory.certificate_terms import NetworkConditions
from noack.theory.certified_bounds import ScenarioCertificate
from noack.theory.scenario_certificates import certify
from tests.noack.theory.broken_policies import BROKEN_POLICIES
from tests.noack.theory.loops import Flags, Steps, System, Trace, random_system, simulate
from tests.noack.theory.policy_loops import KINDS, policy_case, shares_of

_Certify = Callable[[Scenario, NetworkConditions], ScenarioCertificate]
_NAMES = ("e_s", "e_c", "x", "1/δ")


class PolicyLoop:
    """A loop with its policy, and the last certificate of it."""

    def __init__(self, kind: str, system: System, seed: int) -> None:
        self.resolved, self.rule, self.system = policy_case(kind, system, seed)
        self.certificate: ScenarioCertificate | None = None

    def certified(self, certify: _Certify) -> Bounds | None:
        """Certify it; what is compared are shares of the bounds, since these vary in time."""
        self.certificate = certify(self.resolved, self.system.conditions)
        return None if self.certificate.constants is None else dict.fromkeys(_NAMES, 1.0)

    def simulate(self, rng: np.random.Generator) -> Observed:
        """Search for losses that exceed the certificate."""
        assert self.certificate is not None
        certificate = self.certificate

        def run(system: System, outcomes: Flags, delays: Steps) -> Trace:
            return simulate(system, outcomes, delays, rule=self.rule)

        def worst(system: System, trace: Trace) -> dict[str, float]:
            return shares_of(trace, certificate, system)

        return search(self.system, rng, run, worst)


def _draw(kind: str, where: dict[str, Any], rng: np.random.Generator) -> PolicyLoop:
    if not where and rng.uniform() < 0.5:
        where = {"step_share": 0.002}
    return PolicyLoop(kind, random_system(rng, **where), int(rng.integers(2**32)))


def _certified(certify: _Certify, loop: PolicyLoop) -> Bounds | None:
    return loop.certified(certify)


def _kinds() -> Iterable[Kind]:
    for kind in KINDS:
        broken = {
            mistake.removeprefix(f"{kind}, "): Broken(
                partial(_certified, wrong), partial(_draw, kind, where)
            )
            for mistake, (policy, wrong, where) in BROKEN_POLICIES.items()
            if policy == kind
        }
        yield Kind(
            kind, partial(_draw, kind, {}), partial(_certified, certify), PolicyLoop.simulate,
            broken,
        )  # fmt: skip


POLICIES = tuple(_kinds())
