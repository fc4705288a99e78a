"""Margins: the growth of repeated loss patterns against the certified bounds of all patterns.

The loop and its patterns are those of ``tests/oracles/time_triggered_loops.py``. The pattern of the
lower bound is repeated from the first update on.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from noack.core.linear_systems import spectral_abscissa
from noack.guarantee.loss_guarantee import LossGuarantee
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.theory.time_triggered.scenario_times import without_timeout
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.loss_margin import LossMargin, Stability, capped, checked_guarantee
from tests.noack.theory.certificates.certificate_kinds import Bounds, Broken, Kind, Observed
from tests.noack.theory.certificates.certificate_kinds.policies import scenario_of
from tests.noack.theory.certificates.certificate_kinds.shares import Case, drawn, shares_of
from tests.oracles.lossy_loops import random_system
from tests.oracles.time_triggered_loops import LoopMaps

_ACCURACY = 0.01


def random_scenario(rng: np.random.Generator, **fixed: Any) -> tuple[Scenario, int, int, int]:
    """A loop with periodic updates, or events; its unit in ns, least and most units between two."""
    periodic, share = fixed.pop("periodic", rng.random() < 0.75), rng.choice([0.05, 0.2])
    delayed = fixed.pop("delayed", float(rng.choice([0.0, 0.0, 0.3, 0.99])))
    # For how many units, beyond the delay, the newest update is used; 0: forever.
    usable = fixed.pop("usable", float(rng.choice([0, 0, 1, 2, rng.uniform(0.3, 4)])))
    given = {
        "n": int(rng.choice([1, 2, 2, 3])), "step_share": share, "mansd": int(rng.integers(0, 5)),
        "window": [(1, 1), (1, 1), (1, 4), (2, 5)][rng.integers(4)],
        "recovery": int(rng.choice([0, 0, 1, 3])),
    }  # fmt: skip
    system = random_system(rng, **(given | fixed))
    grows_per_s = rng.uniform(-0.5, 1.5)
    if "rate_per_s" in fixed:
        grows_per_s = fixed["rate_per_s"] - spectral_abscissa(system.A)
    A = system.A + grows_per_s * np.eye(len(system.A))
    system = replace(system, A=A, H=system.H * rng.integers(2))
    step_ns, every = round(system.step_s * 1e9 / 12) * 12, int(rng.integers(1, 4))
    unit_ns = step_ns * every
    least, most = fixed.pop("apart", sorted(rng.integers(1, 4, 2).tolist()))
    if periodic or most == 1:
        unit_ns, least, most = unit_ns * int(rng.integers(1, 9)), 1, 1
        trigger: dict[str, Any] = {"policy": "periodic", "period_s": unit_ns * 1e-9}
        ticks_ns = [step_ns * twelfths // 12 for twelfths in fixed.pop("ticks", (4, 6, 12, 18, 24, 36, 60))]
    else:
        rule = {"policy": "dwell", "interval_s": (least - 0.5) * unit_ns * 1e-9}
        rule["rule"] = {"policy": "absolute", "delta": 1.0}
        trigger = {"policy": "deadline", "interval_s": (most - 0.5) * unit_ns * 1e-9, "rule": rule}
        ticks_ns = [step_ns, unit_ns]
    tick_ns = int(rng.choice(ticks_ns))
    delay_s = delayed * unit_ns * 1e-9
    (losses, window), recovery = system.window, system.recovery
    constraints = [{"kind": "at_most", "losses": losses, "window": window}] * (losses < window)
    constraints += [{"kind": "recovery", "deliveries": recovery}] * (recovery > 0)
    timeout = {"update_timeout_s": round(usable * unit_ns + delay_s * 1e9) * 1e-9} if usable else {}
    scenario = scenario_of(
        system, trigger, model={"allow_unstable": True},
        plant={"rate_hz": 1e9 / step_ns, "measure_every": every},
        controller={
            "rate_hz": 1e9 / tick_ns, "phase": float(rng.choice([0.0, 0.25, 0.5])),
            "timeout_input": str(rng.choice(["safe", "hold"])), **timeout,
        },
        network={
            "constraints": constraints,
            "impairments": [{"kind": "delay", "delay_s": delay_s}] * (delay_s > 0),
        },
    )  # fmt: skip
    return scenario, unit_ns, least, most


def random_loop(rng: np.random.Generator, **fixed: Any) -> LoopMaps:
    """The same, with its maps."""
    scenario, *times = random_scenario(rng, **fixed)
    return LoopMaps(resolve(scenario), *times)


def bounded(resolved: Scenario, guarantee: LossGuarantee | None = None) -> Stability:
    """The certified bounds."""
    return LossMargin(resolved).stability(guarantee, _ACCURACY, decide=False)


def _one_loss_less(loop: LoopMaps) -> Stability:
    guarantee = loop.resolved.network.guarantee
    return bounded(loop.resolved, capped(guarantee, (guarantee.longest_burst or 0) - 1))


def _no_delay(loop: LoopMaps) -> Stability:
    network = loop.resolved.network.model_copy(update={"impairments": ()})
    return bounded(loop.resolved.model_copy(update={"network": network}))


def _used_forever(loop: LoopMaps) -> Stability:
    return bounded(without_timeout(loop.resolved))


def _soon(loop: LoopMaps) -> Stability:
    margin = LossMargin(loop.resolved)
    shortest, longest = margin.loop.between[0], margin.loop.between[-1]
    margin.loop.between = range(shortest, shortest + 1)
    stability = margin.stability(None, _ACCURACY, decide=False)
    return stability._replace(upper=stability.upper ** (longest / shortest), pattern=())


def _late_pattern(loop: LoopMaps) -> Stability:
    stability = bounded(loop.resolved)
    return stability._replace(pattern=stability.pattern[1:] + stability.pattern[:1])


def _each_burst_alone(loop: LoopMaps) -> Stability:
    margin = LossMargin(loop.resolved)
    checked = margin.loop.under(checked_guarantee(margin.guarantee))
    growths = (
        np.abs(np.linalg.eigvals(floats(checked.matrix(burst)))).max() ** (checked.between[-1] / burst.units)
        for burst in checked.bursts
        if burst.source == burst.target
    )
    return bounded(loop.resolved)._replace(upper=float(max(growths)))


def growth_shares(loop: LoopMaps, stability: Stability, rng: np.random.Generator) -> Observed:
    """Compare both bounds of the growth: with patterns, and with the own pattern of the lower one."""
    runs, growth = loop.worst_pattern(rng)
    lower = 0.0
    if stability.pattern:
        lower = stability.lower / loop.growth_of(stability.pattern, stability.intervals_s)
    return Observed(runs, {"growth": growth / stability.upper, "pattern": lower})


def _bounds(certify: Callable[[LoopMaps], Stability]) -> Callable[[Case], Bounds | None]:
    return shares_of(("growth", "pattern"), lambda case: certify(case.loop))


_BURSTS = {"mansd": 3, "window": (1, 1)}
_ONE_SLOT = {"n": 2, "recovery": 0, "ticks": (12,)}

MARGINS = Kind(
    "margin", drawn(random_loop, {}), _bounds(lambda loop: bounded(loop.resolved)),
    lambda case, rng: growth_shares(case.loop, case.certified, rng),
    {
        mistake: Broken(_bounds(certify), drawn(random_loop, where))
        for mistake, certify, where in (
            ("one loss less", _one_loss_less, _BURSTS),
            ("no delay", _no_delay, {"delayed": 0.99}),
            ("each burst alone, repeated", _each_burst_alone, _BURSTS | _ONE_SLOT),
            ("the pattern begins an update late", _late_pattern, {"periodic": True, "ticks": (36, 60)}),
            ("an update is used however old it is", _used_forever, {"usable": 1.0} | _BURSTS),
            ("events are the shortest time apart", _soon, {"periodic": False, "apart": (1, 3)}),
        )
    },
)  # fmt: skip
