"""The features' behaviours by number, and the function that applies a stage's behaviour."""

from collections.abc import Sequence

from noack.impairments.disciplines import DISCIPLINES
from noack.impairments.feature import Behaviour
from noack.impairments.kinds import IMPAIRMENTS
from noack.impairments.link_records import PacketContext, RuleStage, StageMemory
from noack.impairments.loss_models import LOSS_MODELS

BEHAVIOURS: Sequence[Behaviour] = tuple(
    feature.behaviour
    for feature in (*LOSS_MODELS, *DISCIPLINES, *IMPAIRMENTS)
    if feature.behaviour is not None
)
"""A stage's ``kind`` is a place in this sequence."""
STAGE_RECORDS: Sequence[type] = (RuleStage, *(behaviour.stage for behaviour in BEHAVIOURS))
QUEUE_RECORDS: Sequence[type] = tuple(dict.fromkeys(behaviour.queue for behaviour in BEHAVIOURS))


def apply_stage(packet: PacketContext, stage: RuleStage, memory: StageMemory) -> None:
    """Apply a stage's behaviour to a packet; see :class:`noack.impairments.feature.Behaviour`.

    Compiled code has a comparison for each behaviour instead; see
    :func:`netem.engine.compiled_rules.compiled_dispatch`.
    """
    BEHAVIOURS[stage.kind].apply(packet, stage, memory)
