"""Kinds of impairments, one per file."""

from typing import TYPE_CHECKING

from netem.core.settings_section import kinds_in, union_of
from netem.impairments.feature import Impairment

_KINDS = kinds_in(__name__, Impairment)
IMPAIRMENTS = tuple(_KINDS.values())

if TYPE_CHECKING:
    AnyImpairment = Impairment
else:
    AnyImpairment = union_of(_KINDS)
