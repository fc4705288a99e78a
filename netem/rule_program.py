"""From the settings of a link to the program that its rules read, and to a fresh state.

Random streams are named after the link, the direction and the impairment, with a number if there
are several of a kind; so adding a delay does not change what is lost.
"""

import math
from collections import Counter
from collections.abc import Sequence
from itertools import accumulate
from typing import NamedTuple

import numpy as np

from netem.rule_records import (
    BlackoutSettings,
    ChanceSettings,
    Counters,
    DelaySettings,
    FlowState,
    FourStateSettings,
    GilbertElliottSettings,
    LinkState,
    QueueState,
    RateSettings,
    RecordedDecision,
    RuleStage,
    ScriptSettings,
    StageMemory,
)
from netem.rules import delay as shapes
from netem.rules import link_rules as rules
from netem.rules.link_rules import LinkMemory, LinkProgram
from netem.rules.mansd import NEVER_NS
from netem.rules.normal import score
from noack.config.impairments import (
    BernoulliLoss,
    Blackout,
    Corrupt,
    Delay,
    Duplicate,
    FourStateLoss,
    GilbertElliottLoss,
    Impairment,
    LinkSettings,
    Loss,
    LossOf,
    NoLoss,
    PeriodicLoss,
    Rate,
    Reorder,
    ScriptedLoss,
    TraceLoss,
    WorstCaseLoss,
)
from noack.core.clock import NS_PER_S
from noack.core.random_streams import stream_key

_SHAPES = {
    "uniform": shapes.UNIFORM,
    "normal": shapes.NORMAL,
    "pareto": shapes.PARETO,
    "paretonormal": shapes.PARETONORMAL,
    "empirical": shapes.EMPIRICAL,
}


def program_of(
    settings: LinkSettings,
    seed: int,
    *name: str,
    decisions: Sequence[Sequence[RecordedDecision]] = (),
    tracks: bool = False,
) -> LinkProgram:
    """Return the program of one direction of a link.

    Args:
        settings: what it does; files are read already (:mod:`noack.config.impairment_files`).
        seed: seed of its random streams.
        name: names of the link and the direction; part of its random streams' names.
        decisions: recorded decisions of each flow, taken again before the settings apply.
        tracks: something may be under way from before.
    """
    builder = _Builder(seed, name)
    for impairment in settings.impairments:
        builder.add(impairment)
    delays = any(isinstance(one, Delay | Rate) for one in settings.impairments)
    return LinkProgram(
        **builder.tables._asdict(),
        decisions=[decision for flow in decisions for decision in flow],
        decisions_begin=list(accumulate(map(len, decisions), initial=0)) if decisions else [],
        mansd=-1 if settings.mansd is None else settings.mansd,
        limit=settings.limit,
        scored=any(
            isinstance(one, Delay) and one.loss_correlation != 0 for one in settings.impairments
        ),
        tracks=tracks or delays or bool(decisions),
    )


def stream_names(settings: LinkSettings, *name: str) -> list[tuple[str, ...]]:
    """Return the names of the random streams of a program's stages, in their order.

    Args:
        settings: what the link does.
        name: names of the link and the direction.
    """
    builder = _Builder(0, name)
    for impairment in settings.impairments:
        builder.add(impairment)
    return builder.streams


def empty_state(program: LinkProgram) -> LinkMemory:
    """Return a state without flows."""
    return LinkMemory(
        flows=[],
        memory=[],
        recent_ns=[],
        queues=[QueueState(0, 0, 0, 0, 0) for _ in program.bottlenecks],
        departures_ns=[0] * sum(bottleneck.queue for bottleneck in program.bottlenecks),
        link=LinkState(0),
        counters=Counters(),
    )


def new_flow(number: int, first_delivered: bool) -> FlowState:
    """Return the state of a flow before its first datagram."""
    return FlowState(number, 0, 0, int(first_delivered), NEVER_NS, 0.0, -1, 0, 0)


def new_memory(program: LinkProgram) -> list[StageMemory]:
    """Return what the stages remember of a new flow."""
    return [StageMemory(0, 0.0) for _ in program.stages]


def recent_width(program: LinkProgram) -> int:
    """Length of a flow's ring of release times."""
    return program.mansd + 1 if program.tracks and program.mansd >= 0 else 1


class _Tables(NamedTuple):
    stages: list[RuleStage]
    chances: list[ChanceSettings]
    chains: list[GilbertElliottSettings]
    four_states: list[FourStateSettings]
    scripts: list[ScriptSettings]
    waits: list[DelaySettings]
    bottlenecks: list[RateSettings]
    darknesses: list[BlackoutSettings]
    integers: list[int]
    reals: list[float]


class _Builder:
    def __init__(self, seed: int, name: Sequence[str]) -> None:
        self.tables = _Tables([], [], [], [], [], [], [], [], [], [])
        self._seed = seed
        self._name = name
        self._numbers: Counter[str] = Counter()
        self.streams: list[tuple[str, ...]] = []
        """Names of the stages' random streams."""

    def add(self, impairment: Impairment) -> None:
        tables = self.tables
        match impairment:
            case LossOf():
                self._add_loss(impairment.loss)
            case Duplicate():
                self._add_chance(rules.DUPLICATE, impairment)
            case Corrupt():
                self._add_chance(rules.CORRUPT, impairment)
            case Reorder():
                self._add_chance(rules.REORDER, impairment, impairment.gap)
            case Delay():
                self._stage(rules.DELAY, "delay", len(tables.waits))
                tables.waits.append(self._wait(impairment))
            case Rate():
                self._stage(rules.RATE, "rate", len(tables.bottlenecks))
                begin = sum(bottleneck.queue for bottleneck in tables.bottlenecks)
                tables.bottlenecks.append(
                    RateSettings(
                        impairment.rate_bps,
                        impairment.queue,
                        impairment.overhead_bytes,
                        impairment.cell_bytes,
                        impairment.cell_overhead_bytes,
                        begin,
                    )
                )
            case Blackout():
                self._stage(rules.BLACKOUT, "blackout", len(tables.darknesses))
                times_ns = [_ns(t_s) for interval in impairment.intervals_s for t_s in interval]
                every_ns = 0 if impairment.every_s is None else _ns(impairment.every_s)
                tables.darknesses.append(BlackoutSettings(*self._integers(times_ns), every_ns))

    def _add_loss(self, loss: Loss) -> None:
        tables = self.tables
        match loss:
            case NoLoss():
                pass
            case BernoulliLoss():
                self._add_chance(rules.BERNOULLI, loss, name="loss")
            case GilbertElliottLoss():
                self._stage(rules.GILBERT_ELLIOTT, "loss", len(tables.chains))
                p, r = loss.transitions
                share = p / (p + r) if p + r > 0 else 0.0
                tables.chains.append(
                    GilbertElliottSettings(p, r, loss.loss_in_good, loss.loss_in_bad, share)
                )
            case FourStateLoss():
                self._stage(rules.FOUR_STATE, "loss", len(tables.four_states))
                tables.four_states.append(
                    FourStateSettings(loss.p13, loss.p31, loss.p32, loss.p23, loss.p14)
                )
            case PeriodicLoss():
                self._stage(rules.SCRIPTED, "loss", len(tables.scripts))
                tables.scripts.append(ScriptSettings(loss.period, 0, 0, loss.burst, loss.first))
            case ScriptedLoss():
                self._stage(rules.SCRIPTED, "loss", len(tables.scripts))
                tables.scripts.append(
                    ScriptSettings(loss.repeat_every, *self._integers(loss.lost), burst=-1, first=0)
                )
            case WorstCaseLoss():
                self._stage(rules.WORST_CASE, "loss", 0)
            case TraceLoss():
                raise ValueError(f"{loss.file}: the trace has not been read")

    def _add_chance(
        self, kind: int, impairment: BernoulliLoss | Duplicate | Corrupt | Reorder, gap: int = 1,
        name: str | None = None,
    ) -> None:  # fmt: skip
        self._stage(kind, name or impairment.model_dump()["kind"], len(self.tables.chances))
        p, correlation = impairment.probability, impairment.correlation
        threshold = -score(p) if 0 < p < 1 else math.copysign(math.inf, 0.5 - p)
        innovation = math.sqrt(1 - correlation**2)
        self.tables.chances.append(ChanceSettings(p, threshold, correlation, innovation, gap))

    def _wait(self, impairment: Delay) -> DelaySettings:
        if impairment.file is not None:
            raise ValueError(f"{impairment.file}: the delays have not been read")
        table_ns = sorted(t_s * NS_PER_S for t_s in impairment.samples_s or ())
        begin = len(self.tables.reals)
        self.tables.reals.extend(table_ns)
        return DelaySettings(
            float(_ns(impairment.delay_s)),
            impairment.jitter_s * NS_PER_S,
            _SHAPES[impairment.distribution],
            begin,
            begin + len(table_ns),
            impairment.correlation,
            math.sqrt(1 - impairment.correlation**2),
            impairment.loss_correlation,
            math.sqrt(1 - impairment.loss_correlation**2),
        )

    def _stage(self, kind: int, name: str, place: int) -> None:
        self._numbers[name] += 1
        number = self._numbers[name]
        own = name if number == 1 else f"{name} {number}"
        self.streams.append(("netem", *self._name, own))
        key = stream_key(self._seed, *self.streams[-1])
        self.tables.stages.append(RuleStage(kind, place, *key))

    def _integers(self, numbers: Sequence[int]) -> tuple[int, int]:
        begin = len(self.tables.integers)
        self.tables.integers.extend(np.asarray(numbers, dtype=np.int64).tolist())
        return begin, begin + len(numbers)


def _ns(t_s: float) -> int:
    return round(t_s * NS_PER_S)
