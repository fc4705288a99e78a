"""Kinds of pieces of a reference, one per file: its settings, and the output's value over time."""

from typing import TYPE_CHECKING

from netem.core.settings_section import kinds_in, union_of
from noack.references.piece_settings import PieceSettings

if TYPE_CHECKING:
    AnyPiece = PieceSettings
else:
    AnyPiece = union_of(kinds_in(__name__, PieceSettings))
