"""Makes the program that a link's rules read from its settings, and a new state.

Random streams are named after the link, the direction and the impairment, with a number if there
are several of a kind. Hence adding a delay does not change which packets are lost.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import accumulate
from typing import NamedTuple

from netem.rules.guarantee import counts_losses
from noack.core.random_streams import stream_key
from noack.impairments.feature import StageTables
from noack.impairments.kept_loss import with_kept_loss
from noack.impairments.link_records import (
    NEVER_NS,
    Counters,
    FlowState,
    LinkMemory,
    LinkProgram,
    LinkState,
    RecordedDecision,
    RuleStage,
    StageMemory,
    WindowRule,
)
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_guarantee import DeliveriesBetweenBursts, LossesInWindow
from noack.impairments.stage_dispatch import BEHAVIOURS


def program_of(
    settings: LinkSettings,
    seed: int,
    *name: str,
    decisions: Sequence[Sequence[RecordedDecision]] = (),
    tracks: bool = False,
) -> LinkProgram:
    """Return the program of one direction of a link; see :class:`netem.link_machine.Link`.

    Args:
        settings: the settings.
        seed: seed of its random streams.
        name: names of the link and the direction.
        decisions: recorded decisions per flow.
        tracks: packets may be in flight from earlier settings.

    Raises:
        ValueError: the settings name a file that has not been read, or a loss rate cannot be kept.
    """
    settings = with_kept_loss(settings)
    scored = any(getattr(one, "loss_correlation", 0) != 0 for one in settings.impairments)
    tables = StageTables(scored=scored)
    stages = []
    places = 0
    for number, (stage, _) in enumerate(_stages(settings, tables, seed, name)):
        stage.place = number
        stage.queue_begin = places
        places += stage.queue_places
        stages.append(stage)
    delays = any(one.delays for one in settings.impairments)
    rules = [one.rule for one in settings.constraints]
    return LinkProgram(
        stages=stages,
        integers=tables.integers,
        reals=tables.reals,
        decisions=[decision for flow in decisions for decision in flow],
        decisions_begin=list(accumulate(map(len, decisions), initial=0)) if decisions else [],
        windows=[
            WindowRule(rule.limit, rule.window)
            for rule in rules
            if isinstance(rule, LossesInWindow)
        ],
        recovery=max(
            (rule.deliveries for rule in rules if isinstance(rule, DeliveriesBetweenBursts)),
            default=0,
        ),
        mansd=-1 if settings.longest_burst is None else settings.longest_burst,
        limit=settings.limit,
        tracks=tracks or delays or bool(decisions),
    )


def stream_names(settings: LinkSettings, *name: str) -> list[tuple[str, ...]]:
    """Return the names of the random streams of a program's stages, in their order."""
    return [stream for _, stream in _stages(settings, StageTables(), 0, name)]


def _stages(
    settings: LinkSettings, tables: StageTables, seed: int, name: Sequence[str]
) -> Iterator[tuple[RuleStage, tuple[str, ...]]]:
    """Return the stages, each with the name of its random stream."""
    numbers: Counter[str] = Counter()
    for impairment in settings.impairments:
        number = numbers[impairment.kind] + 1
        own = impairment.kind if number == 1 else f"{impairment.kind} {number}"
        stream = ("netem", *name, own)
        tables.key = stream_key(seed, *stream)
        stage, rule = impairment.stage(tables), impairment.rule
        if stage is None or rule is None:
            continue
        stage.kind = BEHAVIOURS.index(rule)
        stage.key0, stage.key1 = tables.key
        numbers[impairment.kind] = number
        yield stage, stream


def empty_state(program: LinkProgram) -> LinkMemory:
    """Return a state without flows."""
    return LinkMemory(
        flows=[],
        memory=[],
        recent_ns=[],
        losses=[],
        queues=[BEHAVIOURS[stage.kind].queue() for stage in program.stages],
        departures_ns=[0] * sum(stage.queue_places for stage in program.stages),
        link=LinkState(),
        counters=Counters(),
    )


class FlowRow(NamedTuple):
    """The state of a flow: its row of each table of :class:`LinkMemory` that has a row per flow."""

    flows: FlowState
    memory: list[StageMemory]
    recent_ns: list[int]
    losses: list[int]


def new_row(program: LinkProgram, flow: FlowState, *, restarted: bool = False) -> FlowRow:
    """Return the state of a flow before its first packet; see :func:`new_losses`."""
    memory = [StageMemory() for _ in program.stages]
    recent_ns = [NEVER_NS] * recent_width(program)
    return FlowRow(flow, memory, recent_ns, new_losses(program, restarted=restarted))


def new_flow(number: int, first_delivered: bool) -> FlowState:
    """Return the numbers of a flow before its first packet."""
    return FlowState(number, forced_first=int(first_delivered))


def new_losses(program: LinkProgram, *, restarted: bool) -> list[int]:
    """Return a new flow's ring of numbers of losses.

    ``restarted``: packets of the flow may have been lost before. The guarantee then counts as many
    losses directly before the first packet as a window may have.
    """
    width = loss_width(program)
    if not restarted:
        return [0] * width
    assumed = max((window.losses for window in program.windows), default=1)
    return [-min(-place % width, assumed) for place in range(width)]


def recent_width(program: LinkProgram) -> int:
    """Length of a flow's ring of release times, a power of 2."""
    return 1 << program.mansd.bit_length() if program.tracks and program.mansd >= 0 else 1


def loss_width(program: LinkProgram) -> int:
    """Length of a flow's ring of numbers of losses, a power of 2; 1: it is not needed."""
    if not counts_losses(program):
        return 1
    longest = max((window.packets for window in program.windows), default=0)
    return 1 << max(longest + 1, program.mansd + program.recovery + 1).bit_length()
