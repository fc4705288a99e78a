"""The campaign of a capacity study: policies × numbers of loops × disturbances.

The draws have common random numbers: loop k of draw i is the same for any policy. If all loops are
of one kind, it is the same for any number of loops, too, and the reference of their cost is that of
one loop. The reference of loops of several kinds is the same loops on a link that is as many times
as fast as there are loops.

A static schedule is the bottleneck if the network has no other: 1 datagram for each slot. For every
number of loops, each loop has one slot in turn.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

from pydantic import JsonValue

from cosim.studies.campaign.campaign_file import Campaign, CampaignAxis, Metrics
from cosim.studies.campaign.drawn_runs import cost_of
from cosim.studies.capacity.loop_kinds import Entry, LoopKind, smallest_mixture
from noack.core.errors import CallerError
from noack.impairments.kinds.rate import Rate
from noack.impairments.kinds.schedule import Schedule
from noack.impairments.words import time_text
from noack.protocol.wire_format import datagram_bytes
from noack.scenario.scenario import Scenario

POLICY, LOOPS, DISTURBANCE = "policy", "number_of_loops", "disturbance"
"""The axes."""
OWN, COMMON = "as in the scenario", "common"
"""Values of the axis of disturbances."""


class StudyDefaults(NamedTuple):
    """Defaults of a quick or a thorough study."""

    shares: tuple[float, ...]
    """Numbers of loops, as shares of the periodic loops that the link carries."""
    draws: int
    amplitude: float
    """Amplitude of the common disturbance; 0: no such runs."""


QUICK = StudyDefaults((0.5, 1.0, 1.5), 6, 0.0)
THOROUGH = StudyDefaults((0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0), 10, 1.0)
_PULSE_S = 0.5
"""Length of the common disturbance."""
_QUEUE = 10
"""Queue of a bottleneck that the scenario does not have."""


@dataclass(frozen=True)
class CapacityPlan:
    """What a capacity study runs."""

    scenario: Scenario
    """The loops and the network; not resolved."""
    kinds: tuple[LoopKind, ...]
    """The kinds of loops."""
    file: Path
    settings: Mapping[str, JsonValue]
    """Settings of all runs, which replace the scenario's."""
    deadline_s: float
    counts: tuple[int, ...]
    policies: Mapping[str, Mapping[str, JsonValue]]
    """Settings of each policy."""
    amplitude: float
    """Amplitude of the common disturbance; 0: no such runs."""
    draws: int
    seed: int

    @property
    def rate_bps(self) -> int | None:
        """Rate of the bottleneck; None: it is a schedule."""
        limit = bottleneck(self.scenario)
        return limit.rate_bps if isinstance(limit, Rate) else None

    @property
    def link(self) -> str:
        """The bottleneck, in words."""
        limit = bottleneck(self.scenario)
        if isinstance(limit, Rate):
            return f"{limit.rate_bps / 1000:g} kbit/s"
        return f"slots of {time_text(limit.slot_s)}"

    @property
    def periodic_loops(self) -> float:
        """Number of periodic loops of the mixture whose updates the bottleneck carries."""
        return periodic_loops(self.scenario, self.kinds)

    @property
    def is_one_kind(self) -> bool:
        """Whether all loops have the same settings in the scenario."""
        return len(self.kinds) == 1

    @property
    def cost_columns(self) -> list[str]:
        """The columns of the runs with the mean cost of the loops of each kind."""
        return ["cost"] if self.is_one_kind else [cost_of(kind.name) for kind in self.kinds]

    def with_defaults(self, defaults: StudyDefaults) -> "CapacityPlan":
        """Return the plan with other defaults."""
        counts = default_counts(self.periodic_loops, smallest_mixture(self.kinds), defaults)
        return replace(self, counts=counts, draws=defaults.draws, amplitude=defaults.amplitude)

    @property
    def sizes(self) -> list[int]:
        """Numbers of loops of the runs of a draw."""
        sizes = self.counts if self.is_one_kind else [*self.counts, *self.counts]
        return [*sizes] * (len(self.policies) * (2 if self.amplitude else 1))

    def factor(self, loops: float) -> float:
        """Return a number of loops as a multiple of the mixture that the scenario has."""
        return loops / sum(kind.loops for kind in self.kinds)

    def composition(self, loops: float) -> dict[str, int]:
        """Return how many loops of each kind a finite number of loops has."""
        return {kind.name: round(self.factor(loops) * kind.loops) for kind in self.kinds}

    @property
    def counted_from_s(self) -> float:
        """Start of the part of a run that counts for the guarantee and the deadline."""
        return self.scenario.horizon_s / 5

    def campaign(self) -> Campaign:
        """Return the campaign of all runs."""
        axes = [
            CampaignAxis(
                name=POLICY, variants={name: dict(settings) for name, settings in self.policies.items()}
            ),
            self._numbers(),
        ]
        if self.amplitude:
            begin_s = self.scenario.horizon_s / 2
            pulse: Entry = {"kind": "step", "from_s": begin_s, "until_s": begin_s + _PULSE_S}
            variants = {
                name: {
                    f"loops.{number}.plant.disturbances": kind.disturbed(pulse, amplitude)
                    for number, kind in enumerate(self.kinds)
                }
                for name, amplitude in ((OWN, 0.0), (COMMON, self.amplitude))
            }
            axes.append(CampaignAxis.model_validate({"name": DISTURBANCE, "variants": variants}))
        return Campaign(
            name=self.scenario.name,
            description=f"How many loops does a link of {self.link} carry?",
            scenario=str(self.file.resolve()),
            settings=dict(self.settings),
            time="sampled",
            draws=self.draws,
            seed=self.seed,
            chunk=1,
            axes=tuple(axes),
            metrics=Metrics(
                shown=(
                    "transmissions",
                    "lost_share",
                    "loops_guarantee_used",
                    "updates_late",
                    "delay_max_s",
                    "cost",
                    "cost_worst",
                ),
                count_from_s=self.counted_from_s,
            ),
        )

    def _numbers(self) -> CampaignAxis:
        """Return the axis of the numbers of loops."""
        title = "number of loops"
        if self.is_one_kind and isinstance(bottleneck(self.scenario), Rate):
            return CampaignAxis(name=LOOPS, title=title, key="loops", values=self.counts)
        variants = {str(count): self._network(count, 1) for count in self.counts}
        if not self.is_one_kind:
            variants |= {unshared_label(count): self._network(count, count) for count in self.counts}
        return CampaignAxis(name=LOOPS, title=title, variants=variants)

    def _network(self, loops: int, factor: int) -> Entry:
        """Return the settings of loops on bottlenecks ``factor`` times as fast, with longer queues."""
        settings: Entry = {"loops": loops}
        for index, impairment in enumerate(self.scenario.network.impairments):
            key = f"network.impairments.{index}"
            if isinstance(impairment, Schedule):
                settings[f"{key}.order"] = [*range(loops)]
                settings[f"{key}.slot_s"] = max(impairment.slot_s / factor, 1e-6)
            if isinstance(impairment, Rate) and factor > 1:
                settings[f"{key}.rate_bps"] = min(impairment.rate_bps * factor, 10**12)
                settings[f"{key}.queue"] = min(impairment.queue * factor, 10**6)
        return settings


def unshared_label(count: int) -> str:
    """Return the label of the runs of loops that each have the rate of the link for themselves."""
    return f"{count} unshared"


def bottleneck(scenario: Scenario) -> Rate | Schedule:
    """Return the slowest bottleneck of the network; without a rate, its schedule.

    Raises:
        CallerError: it has none.
    """
    stages = scenario.network.impairments
    rates = [stage for stage in stages if isinstance(stage, Rate)]
    schedules = [stage for stage in stages if isinstance(stage, Schedule)]
    if not rates and not schedules:
        raise CallerError(
            "network.impairments: no bottleneck that the loops could share; "
            "give --rate-bps, or an impairment of kind rate or schedule"
        )
    return min(rates, key=lambda rate: rate.rate_bps) if rates else schedules[0]


def periodic_loops(scenario: Scenario, kinds: Sequence[LoopKind]) -> float:
    """Return how many periodic loops, in the kinds' proportions, a bottleneck of R bit/s carries.

    A loop needs b / h bits per second, so it is R / (mean of b / h); of one kind, R h / b. In slots
    that the loops have in turn, the shortest h counts.
    """
    queue = bottleneck(scenario)
    if isinstance(queue, Schedule):
        return min(kind.period_s for kind in kinds) / queue.slot_s
    loops = sum(kind.loops for kind in kinds)
    needed_bps = sum(
        kind.loops * int(queue.line_bits(datagram_bytes(kind.scenario.model.dimensions[0]))) / kind.period_s
        for kind in kinds
    )
    return queue.rate_bps * loops / needed_bps


def require_in_time(scenario: Scenario, kinds: Sequence[LoopKind], deadline_s: float) -> None:
    """Raise CallerError if a rate needs longer than the deadline for one update alone."""
    if not isinstance(queue := bottleneck(scenario), Rate):
        return
    updates_bytes = (datagram_bytes(kind.scenario.model.dimensions[0]) for kind in kinds)
    sent_s = max(int(queue.line_bits(update_bytes)) for update_bytes in updates_bytes) / queue.rate_bps
    if sent_s >= deadline_s:
        raise CallerError(
            f"one update takes {sent_s:.3g} s on {queue.rate_bps} bit/s, and is late after "
            f"{deadline_s:.3g} s; give a longer --late-after or --update-period, or a higher --rate-bps"
        )


def with_rate(scenario: Scenario, rate_bps: int) -> Scenario:
    """Return the scenario with this rate of its slowest bottleneck; without one, add it."""
    stages = list(scenario.network.impairments)
    if any(isinstance(stage, Rate) for stage in stages):
        number = stages.index(bottleneck(scenario))
        stages[number] = stages[number].model_copy(update={"rate_bps": rate_bps})
    else:
        stages.append(Rate(rate_bps=rate_bps, queue=_QUEUE))
    network = scenario.network.model_copy(update={"impairments": tuple(stages)})
    return scenario.model_copy(update={"network": network})


def default_counts(periodic: float, smallest: int, defaults: StudyDefaults) -> tuple[int, ...]:
    """Return numbers of loops around that of the periodic loops that the link carries.

    Args:
        periodic: number of periodic loops that the link carries.
        smallest: number of loops of the smallest mixture.
        defaults: those of the study.
    """
    multiples = {max(round(share * periodic / smallest), 1) for share in defaults.shares}
    return require_counts([smallest * multiple for multiple in multiples], smallest)


def require_counts(counts: Sequence[int], smallest: int) -> tuple[int, ...]:
    """Return sorted numbers of loops; of one kind with 1, the reference of the cost.

    Raises:
        CallerError: a number is not a positive multiple of that of the smallest mixture.
    """
    for count in counts:
        if count < 1:
            raise CallerError(f"--loops {count}: numbers of loops are at least 1")
        if count % smallest:
            raise CallerError(
                f"--loops {count}: expected a multiple of {smallest}, to keep the proportions of "
                "[[loops]]; or study one kind, e.g. --set 'loops=[{ name = \"p\" }]'"
            )
    return tuple(sorted({*counts, *([1] if smallest == 1 else [])}))
