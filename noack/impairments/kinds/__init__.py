"""Kinds of impairments, one per file."""

from typing import TYPE_CHECKING

from noack.impairments.feature import Impairment
from noack.settings.section import kinds_in, union_of

_KINDS = kinds_in(__name__, Impairment)
IMPAIRMENTS = tuple(_KINDS.values())

if TYPE_CHECKING:
    AnyImpairment = Impairment
else:
    AnyImpairment = union_of(_KINDS)
