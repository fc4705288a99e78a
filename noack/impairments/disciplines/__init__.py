"""Disciplines of the ``rate`` bottleneck's queue, one per file."""

from typing import TYPE_CHECKING, Annotated, Union

from pydantic import Field

from noack.impairments.feature import QueueDiscipline, features_in

DISCIPLINES = features_in(__name__, __path__, QueueDiscipline)

if TYPE_CHECKING:
    Discipline = QueueDiscipline
else:
    Discipline = Annotated[Union[DISCIPLINES], Field(discriminator="kind")]  # noqa: UP007 - of a tuple
