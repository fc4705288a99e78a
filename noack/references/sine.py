"""A sine wave about a value."""

import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, FiniteFloat

from noack.references.piece_settings import OutputPiece, OutputSignal


class SinePiece(OutputPiece):
    """The output is offset + amplitude · sin(2π hz t + phase), t being the time since its begin."""

    kind: Literal["sine"]
    amplitude: FiniteFloat
    """Amplitude."""
    hz: Annotated[FiniteFloat, Field(gt=0, le=1e6)]
    """Frequency."""
    phase_rad: FiniteFloat = 0.0
    """Phase at its begin."""
    offset: FiniteFloat | None = None
    """The mean value; by default that of the output before."""

    def signal(self, start: float) -> OutputSignal:
        return OutputSignal(
            np.array([start if self.offset is None else self.offset]),
            self.hz,
            self.amplitude * math.cos(self.phase_rad),
            self.amplitude * math.sin(self.phase_rad),
        )
