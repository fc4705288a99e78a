"""Documents that are rejected: the reason is one line, and names what fails."""

from collections.abc import Mapping
from typing import Any

import pytest

from noack.core.balls import is_positive, matrix, number
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop
from noack.proof.search.exact_test import _value
from noack.proof.statement_proof import prove_statement


def rejects(loop: Loop, document: object, match: str) -> None:
    """Require that a document is rejected, and for the reason that is meant."""
    with pytest.raises(RejectedError, match=match) as caught:
        prove_statement(loop, document)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) <= 300


def failing(loop: Loop, entry: Mapping[str, Any], rate: float) -> set[str]:
    """Return the names of all inequalities that fail."""
    model = Model(loop, number(rate), number(entry["decay"]))
    matrices = {name: matrix(rows) for name, rows in entry["matrices"].items()}
    numbers = {name: number(value) for name, value in entry["numbers"].items()}
    every = model.inequalities(entry["output"], starts=True)
    return {item.name for item in every if not is_positive(_value(item, matrices, numbers))}
