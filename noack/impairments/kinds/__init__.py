"""Kinds of impairments, one per file."""

from typing import TYPE_CHECKING, Annotated, Union

from pydantic import Field

from noack.impairments.feature import Impairment, features_in

IMPAIRMENTS = features_in(__name__, __path__, Impairment)

if TYPE_CHECKING:
    AnyImpairment = Impairment
else:
    AnyImpairment = Annotated[Union[IMPAIRMENTS], Field(discriminator="kind")]  # noqa: UP007 - of a tuple
