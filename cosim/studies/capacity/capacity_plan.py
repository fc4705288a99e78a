"""The campaign of a capacity study: policies × numbers of loops × disturbances.

The loop of all runs is the top level of the scenario; its [[loops]] are replaced. The campaign's
draws have common random numbers: loop k of draw i is the same for any policy and number of loops.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.studies.campaign.campaign_file import Axis, Campaign, Metrics
from noack.config.resolution import loop_of, resolve
from noack.config.scenario import Scenario
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.impairments.kinds.rate import Rate
from noack.protocol.wire_format import datagram_bytes
from noack.trigger.periodic_trigger import PeriodicSettings

POLICY, LOOPS, DISTURBANCE = "policy", "number_of_loops", "disturbance"
"""The axes."""
OWN, COMMON = "as in the scenario", "common"
"""Values of the axis of disturbances."""
PERIODIC, ZOH, MODEL = "periodic", "zoh", "model"
_SHARES = (0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0)
"""Default numbers of loops, as shares of the periodic loops that the link carries."""
_PERIOD_PER_TIME_CONSTANT = 0.3
_PULSE_S = 0.5
_QUEUE = 10
"""Queue of a bottleneck that the scenario does not have."""


@dataclass(frozen=True)
class CapacityPlan:
    """What a capacity study runs."""

    scenario: Scenario
    """The loop and the network; not resolved."""
    file: Path
    settings: Mapping[str, Any]
    """Settings of all runs, which replace the scenario's."""
    rate_bps: int
    period_s: float
    """Period of the periodic policy."""
    deadline_s: float
    counts: tuple[int, ...]
    policies: Mapping[str, Mapping[str, Any]]
    """Settings of each policy."""
    amplitude: float
    """Amplitude of the common disturbance; 0: no such runs."""
    draws: int
    seed: int

    @property
    def periodic_loops(self) -> float:
        """Number of periodic loops whose updates the bottleneck carries: R h / bits."""
        return periodic_loops(self.scenario, self.rate_bps, self.period_s)

    @property
    def counted_from_s(self) -> float:
        """Start of the part of a run that counts for the guarantee and the deadline."""
        return self.scenario.horizon_s / 5

    @property
    def pulse_s(self) -> tuple[float, float]:
        """Begin and end of the common disturbance."""
        begin_s = self.scenario.horizon_s / 2
        return begin_s, begin_s + _PULSE_S

    def campaign(self) -> Campaign:
        """Return the campaign of all runs."""
        axes = [
            Axis(name=POLICY, variants={name: dict(one) for name, one in self.policies.items()}),
            Axis(name=LOOPS, title="number of loops", key="loops", values=self.counts),
        ]
        if self.amplitude:
            own = [one.model_dump(mode="json") for one in self.scenario.plant.disturbances]
            own = [{k: v for k, v in one.items() if v is not None} for one in own]
            begin_s, end_s = self.pulse_s
            pulse = {
                "kind": "step", "amplitude": [self.amplitude] * self.scenario.model.dimensions[1],
                "from_s": begin_s, "until_s": end_s,
            }  # fmt: skip
            key = "plant.disturbances"
            variants: dict[str, dict[str, Any]] = {OWN: {key: own}, COMMON: {key: [*own, pulse]}}
            axes.append(Axis(name=DISTURBANCE, variants=variants))
        return Campaign(
            name=self.scenario.name,
            description=f"How many loops does a link of {self.rate_bps / 1000:g} kbit/s carry?",
            scenario=str(self.file.resolve()),
            settings=dict(self.settings),
            time="sampled",
            draws=self.draws,
            seed=self.seed,
            chunk=1,
            axes=tuple(axes),
            metrics=Metrics(
                shown=(
                    "transmissions", "lost_share", "loops_guarantee_used", "updates_late",
                    "delay_max_s", "cost", "cost_worst",
                ),
                count_from_s=self.counted_from_s,
            ),
        )  # fmt: skip


def loops_with_own_settings(scenario: Scenario) -> list[str]:
    """Return the names of [[loops]] with settings of their own, which a study leaves out."""
    drawn = {"name", "count", "phase", "seeds"}
    return [one.name for one in scenario.loops or () if one.model_fields_set - drawn]


def bottleneck(scenario: Scenario) -> Rate:
    """Return the slowest bottleneck of the network.

    Raises:
        CallerError: it has none.
    """
    rates = [one for one in scenario.network.impairments if isinstance(one, Rate)]
    if not rates:
        raise CallerError(
            "network.impairments: no bottleneck that the loops could share; "
            "give --rate-bps, or an impairment of kind rate"
        )
    return min(rates, key=lambda one: one.rate_bps)


def with_rate(scenario: Scenario, rate_bps: int) -> Scenario:
    """Return the scenario with this rate of its slowest bottleneck; without one, add it."""
    stages = list(scenario.network.impairments)
    if any(isinstance(one, Rate) for one in stages):
        place = stages.index(bottleneck(scenario))
        stages[place] = stages[place].model_copy(update={"rate_bps": rate_bps})
    else:
        stages.append(Rate(rate_bps=rate_bps, queue=_QUEUE))
    network = scenario.network.model_copy(update={"impairments": tuple(stages)})
    return scenario.model_copy(update={"network": network})


def periodic_loops(scenario: Scenario, rate_bps: int, period_s: float) -> float:
    """Return the number of periodic loops whose updates a rate carries: R h / bits."""
    bits = int(bottleneck(scenario).line_bits(datagram_bytes(scenario.model.dimensions[0])))
    return rate_bps * period_s / bits


def sampling_period_s(scenario: Scenario) -> float:
    """Return the period that the loop needs by the usual rule ω h ≤ 0.3.

    ω is the largest absolute eigenvalue of Â + B̂K; h is a multiple of the measurement period.

    Raises:
        CallerError: h is not shorter than the run.
    """
    loop = loop_of(resolve(scenario))
    fastest = float(np.abs(np.linalg.eigvals(loop.A_model + loop.B_model @ loop.K)).max())
    measured_s = scenario.timing.measurement_period_ns / NS_PER_S
    if fastest * scenario.horizon_s <= _PERIOD_PER_TIME_CONSTANT:
        raise CallerError(
            f"--update-period: 0.3 / {fastest:.3g}, from the fastest eigenvalue of A + BK, is not "
            f"shorter than the run of {scenario.horizon_s:g} s; give a period"
        )
    return max(math.floor(_PERIOD_PER_TIME_CONSTANT / fastest / measured_s), 1) * measured_s


def require_multiple(period_s: float, scenario: Scenario) -> float:
    """Return a period of transmissions; between two measurements there is none.

    Raises:
        CallerError: it is not a multiple of the measurement period.
    """
    measured_ns = scenario.timing.measurement_period_ns
    if round(period_s * NS_PER_S) % measured_ns:
        raise CallerError(
            f"--update-period {period_s:g}: not a multiple of the time between two measurements, "
            f"{measured_ns / NS_PER_S:g} s"
        )
    return period_s


def default_counts(periodic: float) -> tuple[int, ...]:
    """Return numbers of loops around that of the periodic loops that the link carries."""
    return tuple(sorted({1, *(max(round(share * periodic), 1) for share in _SHARES)}))


def default_policies(scenario: Scenario, period_s: float) -> dict[str, dict[str, Any]]:
    """Return the policies that are always compared.

    Raises:
        CallerError: the scenario's own policy is periodic.
    """
    if isinstance(scenario.trigger, PeriodicSettings):
        raise CallerError(
            'trigger.policy = "periodic": the event-triggered loops need an event-triggered '
            "policy, e.g. --set 'trigger={ policy = \"absolute\", delta = 0.05 }'"
        )
    periodic = {"policy": "periodic", "period_s": period_s}
    return {
        PERIODIC: {"mode": "zoh", "trigger": periodic},
        ZOH: {"mode": "zoh"},
        MODEL: {"mode": "model"},
    }


def require_counts(counts: Sequence[int]) -> tuple[int, ...]:
    """Return sorted numbers of loops, with 1, the reference of the cost.

    Raises:
        CallerError: a number is not positive.
    """
    if (least := min(counts)) < 1:
        raise CallerError(f"--loops {least}: numbers of loops are at least 1")
    return tuple(sorted({1, *counts}))
