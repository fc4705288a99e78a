"""Disciplines of the ``rate`` bottleneck's queue, one per file."""

from typing import TYPE_CHECKING

from netem.core.settings_section import kinds_in, union_of
from netem.impairments.feature import QueueDiscipline

_KINDS = kinds_in(__name__, QueueDiscipline)
DISCIPLINES = tuple(_KINDS.values())

if TYPE_CHECKING:
    Discipline = QueueDiscipline
else:
    Discipline = union_of(_KINDS)
