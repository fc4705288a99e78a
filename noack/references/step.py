"""A step to a value, which the output then keeps."""

from typing import Literal

import numpy as np
from pydantic import FiniteFloat

from noack.references.piece_settings import OutputPiece, OutputSignal


class StepPiece(OutputPiece):
    """The output is constant."""

    kind: Literal["step"]
    value: FiniteFloat
    """The value."""

    def signal(self, start: float) -> OutputSignal:
        return OutputSignal(np.array([self.value]))
