"""Tail drop: a packet that finds the queue full is lost."""

from collections.abc import Mapping
from typing import Literal

from netem.impairments.feature import QueueDiscipline, Stage, StageTables


class TailDrop(QueueDiscipline):
    """A packet that finds the queue full is lost."""

    kind: Literal["tail_drop"] = "tail_drop"

    def meaning(self) -> str:
        return "more are dropped"

    def queue_stage(self, bottleneck: Mapping[str, int], queue_places: int, tables: StageTables) -> Stage:
        return Stage(self.kind, bottleneck, "bottleneck", queue_places)
