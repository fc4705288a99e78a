"""Changed witnesses of a plant on a region: the checker rejects them, or what it accepts is true.

A document has the equations of its plant: changed ones are those of another plant, of which it may be a
proof. So runs of the document's own equations have to stay within its bounds.
"""

import copy
import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from cosim.analysis.witnesses import resolved_content
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.scenario import read_loop
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack_equations import RejectedError as RejectedEquationsError
from tests.checker.changes import DOCUMENTS
from tests.checker.proofs import enclosed_equations, proved
from tests.oracles.attacked_regions import SCENARIOS, Field, Reals, largest_sizes

Document = dict[str, Any]
Rng = np.random.Generator
_STEP_S, _STEPS, _RUNS = 1e-3, 1500, 6
_LATE = 1.02
"""Events of a run are up to a step late, of bounds with tests at all times."""
_OPERATIONS: dict[str, Callable[..., float]] = {
    "sin": np.sin, "cos": np.cos, "negative": np.negative, "add": np.add, "times": np.multiply,
}  # fmt: skip


def field_of(equations: Document) -> Field:
    """Return ẋ by the steps of a document's equations."""

    def field(x: Reals, u: Reals) -> Reals:
        values: list[Any] = []
        for kind, *of in equations["steps"]:
            given = {"state": lambda i: x[i], "input": lambda i: u[i], "number": float, "time": lambda: 0.0}
            values.append(given[kind](*of) if kind in given else _OPERATIONS[kind](*(values[i] for i in of)))
        rates = [np.broadcast_to(values[i], x[0].shape) for i in equations["rates"]]
        return np.stack(rates)

    return field


def _number(document: Document, rng: Rng) -> None:
    numbers = [step for step in document["equations"]["steps"] if step[0] == "number"]
    numbers[rng.integers(len(numbers))][1] *= float(rng.choice([-1.0, 0.5, 0.97, 0.999, 1.001, 1.03, 2.0]))


def _operation(document: Document, rng: Rng) -> None:
    steps = [step for step in document["equations"]["steps"] if step[0] in _OPERATIONS]
    step = steps[rng.integers(len(steps))]
    same = [name for name in _OPERATIONS if (name in {"add", "times"}) == (step[0] in {"add", "times"})]
    step[0] = str(rng.choice(same))


def _operand(document: Document, rng: Rng) -> None:
    steps = document["equations"]["steps"]
    k = int(rng.choice([i for i, step in enumerate(steps) if step[0] in _OPERATIONS]))
    steps[k][rng.integers(1, len(steps[k]))] = int(rng.integers(k))


def _rates(document: Document, rng: Rng) -> None:
    equations = document["equations"]
    equations["rates"][rng.integers(2)] = int(rng.integers(len(equations["steps"])))


def _region(document: Document, rng: Rng) -> None:
    document["region"]["x"][0] *= float(rng.choice([0.5, 0.9, 0.99, 1.001, 1.01, 1.1, 2.0]))


def _further(document: Document, rng: Rng) -> None:
    kind = str(rng.choice(["x", "u"]))
    document["region"][kind][-1] = float(rng.choice([0.5, 5.0, 50.0]))


CHANGES = [_number, _operation, _operand, _rates, _region, _further, *DOCUMENTS.values()]


def proven(content: Document, document: Document) -> tuple[Loop, Proof] | None:
    try:
        loop = read_loop(content, box=False, ideal=True, enclosed=enclosed_equations(content, document))
        return loop, prove_statement(loop, document)
    except (RejectedError, RefusedError, RejectedEquationsError):
        return None


@pytest.mark.parametrize("count", [36, pytest.param(240, marks=pytest.mark.deep)])
def test_changed_witnesses_of_a_region_prove_nothing_false(count: int) -> None:
    content = resolved_content(resolve(load(SCENARIOS / "sine_pendulum.toml")))
    document = {key: value for key, value in proved("sine_pendulum").document.items() if key != "gains"}
    rng, accepted = np.random.default_rng(2), 0
    runs: dict[str, dict[str, Reals]] = {}
    for number in range(count + 1):
        changed = copy.deepcopy(document)
        if number:
            CHANGES[number % len(CHANGES)](changed, rng)
        if (result := proven(content, changed)) is None:
            assert number, "the document itself is accepted"
            continue
        accepted += 1
        loop, proof = result
        equations = json.dumps(changed["equations"])
        if equations not in runs:
            field = field_of(changed["equations"])
            runs[equations] = largest_sizes(loop, field, step_s=_STEP_S, steps=_STEPS, runs=_RUNS)
        run, f1 = runs[equations], np.exp(-float(proof.rate.mid()) * _STEP_S * np.arange(_STEPS))
        for bound in proof.bounds:
            if bound.from_start and bound.output in run:
                limit = float(bound.decaying.mid()) * f1 + float(bound.constant.mid())
                assert (run[bound.output] <= _LATE * limit).all(), (number, bound.output)
    assert count // 8 < accepted < count - count // 8
