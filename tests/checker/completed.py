"""Documents that lack nothing that a loop's model asks for: an inequality decides about them, not a name."""

import copy
import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from noack.core.balls import number
from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import read_assumptions


def completed(
    loop: Loop, document: Mapping[str, Any], signal: float = 0.0, *, whole: bool = False
) -> dict[str, Any]:
    """Return the document with the entries that a loop's model needs and it lacks.

    A location after one loss more is a copy of the one before, with 0 for what this does not have. A form
    in which c is the same everywhere has that of the location without losses. All else is 0: what a document
    does not have it claims to be nothing.

    Args:
        loop: the loop that the document shall be about.
        document: any that is accepted of some other loop.
        signal: the multiplier of each unknown signal that the document does not know.
        whole: keep all bounds; else the first one only, which is the one that is rejected.
    """
    found = copy.deepcopy(dict(document))
    if not whole:
        del found["bounds"][1:]
    rate = number(found["rate"])
    assumed = read_assumptions(loop, rate, found)
    for entry in found["bounds"]:
        matrices, numbers = entry["matrices"], entry["numbers"]
        decay = number(entry["decay"])
        model = Model(loop, rate, decay, assumed.errors, assumed.noise, **assumed.of_model)
        for item in model.inequalities(entry["output"], starts=entry.get("from_start", True)):
            for name, left, _ in item.parts:
                size = left.nrows()
                if np.shape(matrices.get(name)) != (size, size):
                    matrices[name] = _of_size(size, matrices.get(_before(name), []))
            for name, _ in item.scalars:
                least = signal if "/signal " in name else 0.0
                numbers.setdefault(name, numbers.get(_before(name), numbers.get(f"{name}/0 lost", least)))
    return found


def _of_size(size: int, rows: Sequence[Sequence[float]]) -> list[list[float]]:
    k = min(size, len(rows))
    return np.pad(np.array(rows)[:k, :k], (0, size - k)).tolist() if k else np.zeros((size, size)).tolist()


def _before(name: str) -> str:
    return re.sub(r"\d+(?= lost)", lambda lost: str(int(lost[0]) - 1), name, count=1)
