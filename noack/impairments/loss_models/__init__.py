"""Loss models, one per file."""

from typing import TYPE_CHECKING, Annotated, Union

from pydantic import Field

from noack.impairments.feature import LossModel, features_in

LOSS_MODELS = features_in(__name__, __path__, LossModel)

if TYPE_CHECKING:
    Loss = LossModel
else:
    Loss = Annotated[Union[LOSS_MODELS], Field(discriminator="model")]  # noqa: UP007 - of a tuple
