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
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.analysis.witnesses import find_statement, resolved_content
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack_check.check import RejectedError
from noack_check.keys import RefusedError
from noack_check.loop import Loop
from noack_check.proof import Proof, prove
from noack_check.scenario import read_enclosed, read_loop
from tests.checker.runs import floats
from tests.checker.test_mutations import DOCUMENTS
from tests.oracles.attacked_regions import SCENARIOS

Document = dict[str, Any]
Rng = np.random.Generator
_STEP_S, _STEPS = 1e-3, 1500
_LATE = 1.02
"""Events of a run are up to a step late, of bounds with tests at all times."""
_OPERATIONS: dict[str, Callable[..., float]] = {
    "sin": np.sin, "cos": np.cos, "negative": np.negative, "add": np.add, "times": np.multiply,
}  # fmt: skip


def velocity(equations: Document, x: Any, u: Any) -> Any:
    """Return ẋ by the steps of a document's equations, (n,)."""
    values: list[float] = []
    for kind, *of in equations["steps"]:
        given = {"state": lambda i: x[i], "input": lambda i: u[i], "number": float, "time": lambda: 0.0}
        values.append(given[kind](*of) if kind in given else _OPERATIONS[kind](*(values[i] for i in of)))
    return np.array([values[i] for i in equations["rates"]])


def shares(loop: Loop, equations: Document, rng: Rng) -> dict[str, NDArray[np.float64]]:
    """Return the sizes of outputs over a run with random losses, each (steps,)."""
    K, W, H = (floats(M) for M in (loop.gain, loop.weight, loop.H))
    half = expm(H * _STEP_S / 2)
    level, rate, floor = (float(v.mid()) for v in (loop.rule.level, loop.rule.rate, loop.rule.floor))
    x = floats(loop.start)[:, 0]
    x_s, x_c, lost, h = x, x, 0, _STEP_S
    found: dict[str, list[float]] = {"x": [], "x[0]": [], "e_c": []}
    for k in range(_STEPS):
        if np.linalg.norm(W @ (x_s - x)) > max(level * np.exp(-rate * k * h), floor):
            x_s, lost = x, lost + 1 if lost < loop.losses and rng.random() < 0.8 else 0
            x_c = x_c if lost else x
        for name, value in (("x", x), ("x[0]", x[:1]), ("e_c", W @ (x_c - x))):
            found[name].append(float(np.linalg.norm(value)))
        u, x_c = [K @ x_c, K @ half @ x_c, K @ half @ half @ x_c], half @ half @ x_c
        k1 = velocity(equations, x, u[0])
        k2 = velocity(equations, x + h / 2 * k1, u[1])
        k3 = velocity(equations, x + h / 2 * k2, u[1])
        k4 = velocity(equations, x + h * k3, u[2])
        x, x_s = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), half @ half @ x_s
    return {name: np.array(values) for name, values in found.items()}


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
        loop = read_loop(content, box=False, ideal=True, enclosed=read_enclosed(content, document))
        return loop, prove(loop, document)
    except (RejectedError, RefusedError):
        return None


@pytest.mark.parametrize("count", [36, pytest.param(240, marks=pytest.mark.system)])
def test_changed_witnesses_of_a_region_prove_nothing_false(count: int) -> None:
    resolved = resolve(load(SCENARIOS / "sine_pendulum.toml"))
    content = resolved_content(resolved)
    found = find_statement(resolved, "region", "ideal").document
    assert found is not None
    document = {key: value for key, value in found.items() if key != "gains"}
    rng, accepted = np.random.default_rng(2), 0
    runs: dict[str, dict[str, NDArray[np.float64]]] = {}
    for number in range(count + 1):
        changed = copy.deepcopy(document)
        if number:
            CHANGES[number % len(CHANGES)](changed, rng)
        if (result := proven(content, changed)) is None:
            assert number, "the document itself is accepted"
            continue
        accepted += 1
        loop, proof = result
        equations = changed["equations"]
        run = runs.setdefault(json.dumps(equations), shares(loop, equations, np.random.default_rng(1)))
        f1 = np.exp(-float(proof.rate.mid()) * _STEP_S * np.arange(_STEPS))
        for bound in proof.bounds:
            if bound.from_start and bound.output in run:
                limit = float(bound.decaying.mid()) * f1 + float(bound.constant.mid())
                assert (run[bound.output] <= _LATE * limit).all(), (number, bound.output)
    assert count // 8 < accepted < count - count // 8
