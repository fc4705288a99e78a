"""Loss models, one per file."""

from typing import TYPE_CHECKING

from netem.core.settings_section import kinds_in, union_of
from netem.impairments.feature import LossModel

_KINDS = kinds_in(__name__, LossModel, "model")
LOSS_MODELS = tuple(_KINDS.values())

if TYPE_CHECKING:
    Loss = LossModel
else:
    Loss = union_of(_KINDS, "model")
