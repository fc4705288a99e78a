"""Makes the program that a link's rules read from its settings, and a new state.

Random streams are named after the link, the direction and the impairment, with a number if there
are several of a kind. Hence adding a delay does not change which packets are lost.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import accumulate

from noack.core.random_streams import stream_key
from noack.impairments.feature import StageTables
from noack.impairments.link_records import (
    Counters,
    FlowState,
    LinkMemory,
    LinkProgram,
    LinkState,
    RecordedDecision,
    RuleStage,
    StageMemory,
)
from noack.impairments.link_settings import LinkSettings
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
        ValueError: the settings name a file that has not been read.
    """
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
    return LinkProgram(
        stages=stages,
        integers=tables.integers,
        reals=tables.reals,
        decisions=[decision for flow in decisions for decision in flow],
        decisions_begin=list(accumulate(map(len, decisions), initial=0)) if decisions else [],
        mansd=-1 if settings.mansd is None else settings.mansd,
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
        queues=[BEHAVIOURS[stage.kind].queue() for stage in program.stages],
        departures_ns=[0] * sum(stage.queue_places for stage in program.stages),
        link=LinkState(),
        counters=Counters(),
    )


def new_flow(number: int, first_delivered: bool) -> FlowState:
    """Return the state of a flow before its first packet."""
    return FlowState(number, forced_first=int(first_delivered))


def new_memory(program: LinkProgram) -> list[StageMemory]:
    """Return the stages' memory of a new flow."""
    return [StageMemory() for _ in program.stages]


def recent_width(program: LinkProgram) -> int:
    """Length of a flow's ring of release times."""
    return program.mansd + 1 if program.tracks and program.mansd >= 0 else 1
