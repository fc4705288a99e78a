"""A ramp: the output changes at a constant rate."""

from typing import Literal

import numpy as np
from pydantic import FiniteFloat

from noack.references.piece_settings import OutputPiece, OutputSignal


class RampPiece(OutputPiece):
    """The output changes at a constant rate."""

    kind: Literal["ramp"]
    rate_per_s: FiniteFloat
    """Change of the output per second."""
    value: FiniteFloat | None = None
    """The value at its begin; by default that of the output before."""

    def signal(self, start: float) -> OutputSignal:
        return OutputSignal(np.array([start if self.value is None else self.value, self.rate_per_s]))
