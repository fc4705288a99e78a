"""Changed scenarios with a Kalman filter, and changed witnesses of them: nothing false is proven.

The scenario states the filter's gains. With them the error is computed that noise and gusts of the worst
signs reach. The bounds have to contain it.
"""

import copy
import functools
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from cosim.analysis.witnesses import find_statement
from noack.core.balls import matrix, number
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.loop import Loop, Noise
from noack.proof.elaborate.noise import noise_of
from noack.proof.elaborate.scenario import read_loop
from noack.proof.search.results import Proof, read_assumptions
from noack.proof.statement_proof import prove_statement
from tests.checker.changes import DOCUMENTS, GAINS, accepted, places
from tests.checker.loops import FILTERED_MASS
from tests.checker.proofs import proved
from tests.checker.runs import exceeded, floats, require_true
from tests.helpers.resolved_tables import first_loop, tables_of

Array = NDArray[np.float64]
Tables = dict[str, Any]
Rng = np.random.Generator
SETTINGS = ("plant.measure_every=10", "observer.initial_estimate=[0.25,0.05]")
_TESTS, _SECONDS = 150, 1.5
"""So many measurements of the worst error, and the time of a random run."""
_ROUNDING, _NEAR = 1e-9, 0.8


Errors = list[tuple[float, Array, Array]]
"""Of each measurement its time, what the start adds to x̂ − x, and columns of what acts, times ±1."""


class Filter(NamedTuple):
    """A filter and its plant, by the keys of a resolved scenario."""

    A: Array
    C: Array
    stated: Array
    """Gains of the first measurements, the last one for all later ones."""
    start: Array
    """x̂ − x before it."""
    noise: Array
    gusts: Array
    """Columns of disturbances at the input, which may be at their bound from one measurement to the next."""
    step_s: float
    steps: int

    def gains(self) -> list[Array]:
        """Return the gains of the first measurements."""
        return [self.stated[min(k, len(self.stated) - 1)] for k in range(_TESTS)]

    def errors(self, gains: Sequence[Array]) -> Errors:
        """Return what the error is made of at the first measurements."""
        n, T = len(self.A), self.step_s * self.steps
        whole = np.zeros((2 * n, 2 * n))
        whole[:n, :n], whole[:n, n:] = self.A, np.eye(n)
        moved = expm(whole * T)
        Φ, gust = moved[:n, :n], moved[:n, n:] @ self.gusts
        first, columns, found = self.start, np.zeros((n, 0)), list[tuple[float, Array, Array]]()
        for k, L in enumerate(gains):
            rest = np.eye(n) - L @ self.C
            if k:
                first, columns = Φ @ first, np.hstack([Φ @ columns, gust])
            first, columns = rest @ first, np.hstack([rest @ columns, L * self.noise])
            found.append((k * T, first, columns))
        return found


def filter_of(tables: Tables) -> Filter:
    plant, observer = tables["plant"], tables["observer"]
    gusts = [entry["bound"] for entry in plant["disturbances"] if entry["kind"] == "uniform"]
    x = np.array(plant["initial_state"])
    return Filter(
        *(np.array(M) for M in (plant["A"], plant["measurement"]["C"], observer["gains"])),
        start=np.array(observer.get("initial_estimate", 0 * x)) - x,
        noise=np.array(plant["measurement"]["noise_bound"]),
        gusts=np.array(plant["B"]) * gusts[0] if gusts else np.zeros((len(x), 0)),
        step_s=1 / plant["rate_hz"],
        steps=plant["measure_every"],
    )  # fmt: skip


def share_of_error(errors: Errors, noise: Noise, rate: float, W: Array) -> float:
    """Return the largest share of what is proven of W(x̂ − x) that it reaches, in the direction of each row.

    This is of its size, and of what columns add to the part of it that decays smoothly.
    """
    columns, decaying, most = W @ floats(noise.columns), noise.decaying, 0.0
    S, Λ, s = (floats(M) for M in noise.smooth)
    sizes = [float(size) for size in noise.sizes]
    for t, first, driven in errors:
        f1, reached = np.exp(-rate * t), np.abs(W @ driven).sum(axis=1)
        rest = np.abs(W @ (first - (S @ expm(Λ * t) @ s[:, 0] if s.size else 0.0))) + reached
        room = np.abs(columns) @ np.where(np.arange(columns.shape[1]) < decaying, f1, 1.0)
        largest = (np.abs(W @ first) + reached).max()
        most = max(most, float((rest / room).max()), float(largest) / (sizes[0] * f1 + sizes[1]))
    return most


def errors_of(tables: Tables) -> Errors:
    of = filter_of(tables)
    return of.errors(of.gains())


def true_errors(tables: Tables, loop: Loop, proof: Proof, *, seconds: float) -> Errors:
    """Return the errors of a filter; require that they, its gains and a run with them are as proven."""
    assert loop.observer is not None
    of = filter_of(tables)
    gains = of.gains()
    errors = of.errors(gains)
    noise = noise_of(loop, proof.rate)
    assert share_of_error(errors, noise, float(proof.rate), floats(loop.weight)) <= 1 + _ROUNDING
    own = loop._replace(observer=loop.observer._replace(gains=tuple(matrix(L.tolist()) for L in gains)))
    rng = np.random.default_rng(len(noise.columns.entries()))
    assert exceeded(own, proof, rng, seconds, by_forms=False) == []
    return errors


# The bases.


class Base(NamedTuple):
    """A resolved scenario and a witness of it."""

    tables: Tables
    loop: Loop
    document: Tables


BASES = {"by gains": ("pendulum_observed", SETTINGS), "by forms": ("double_integrator", FILTERED_MASS)}


@functools.cache
def base(name: str) -> Base:
    resolved = first_loop(BASES[name][0], *BASES[name][1])
    tables = tables_of(resolved)
    if name == "by gains":
        found = find_statement(resolved, "own", "schedule", most_work=0).document
        assert found is not None
        document = found
    else:
        document = {key: value for key, value in proved("filtered_mass").document.items() if key != "gains"}
    return Base(tables, read_loop(tables, box=False, ideal=False), document)


def proven(tables: Tables, document: Mapping[str, object]) -> tuple[Loop, Proof] | None:
    try:
        loop = read_loop(tables, box=False, ideal=False)
        return loop, prove_statement(loop, document)
    except (RejectedError, RefusedError):
        return None


# Changed scenarios.

_SOME = (0.5, 0.9, 0.98, 1.02, 1.1, 2.0)


def _number(section: str, key: str, factors: tuple[float, ...] = _SOME) -> Callable[[Tables, Rng], None]:
    """Scale one number of a key; one that is 0 becomes a small one."""

    def change(tables: Tables, rng: Rng) -> None:
        found = places(tables[section], *key.split())
        container, place = found[rng.integers(len(found))]
        factor = float(rng.choice(factors))
        container[place] = container[place] * factor if container[place] else factor / 100

    return change


def _all_numbers(section: str, key: str, factors: tuple[float, ...]) -> Callable[[Tables, Rng], None]:
    def change(tables: Tables, rng: Rng) -> None:
        factor = float(rng.choice(factors))
        for container, place in places(tables[section], key):
            container[place] *= factor

    return change


def _both_plants(key: str) -> Callable[[Tables, Rng], None]:
    def change(tables: Tables, rng: Rng) -> None:
        _number("model", key, (0.95, 1.05))(tables, rng)
        tables["plant"][key] = copy.deepcopy(tables["model"][key])

    return change


def _one_of(section: str, key: str, values: tuple[object, ...]) -> Callable[[Tables, Rng], None]:
    def change(tables: Tables, rng: Rng) -> None:
        tables[section][key] = values[rng.integers(len(values))]

    return change


def _other_outputs(tables: Tables, rng: Rng) -> None:
    row, size = [float(rng.choice([0.9, 1.0, 2.0])), float(rng.choice([0.0, 0.05]))], rng.choice([1e-3, 0.02])
    tables["plant"]["measurement"] = {"C": [row], "noise_bound": [float(size)]}


def _gusts(tables: Tables, rng: Rng) -> None:
    tables["plant"]["disturbances"] = [
        {"kind": "uniform", "at": "input", "bound": [float(rng.uniform(0, 4))]}
    ]


SCENARIOS: dict[str, Callable[[Tables, Rng], None]] = {
    "a gain": _number("observer", "gains", (-1.0, 0.5, 0.98, 1.02, 2.0)),
    "all gains": _all_numbers("observer", "gains", (-1.0, 0.0, 0.5, 0.9, 0.98, 1.02, 1.1, 2.0)),
    "the first estimate": _number("observer", "initial_estimate", (-1.0, 0.0, 0.9, 1.1, 2.0)),
    "x(0)": _number("plant", "initial_state", (-1.0, 0.9, 1.1)),
    "C": _other_outputs,
    "the bound of the noise": _all_numbers("plant", "measurement", (0.5, 0.95, 1.05, 2.0)),
    "gusts": _gusts,
    "times of measurements": _one_of("plant", "measure_every", (1, 2, 5, 8, 9, 11, 12, 15, 20)),
    "times of the plant": _one_of("plant", "rate_hz", (80.0, 250.0, 400.0, 625.0, 1000.0)),
    "A": _both_plants("A"),
    "B": _both_plants("B"),
    "K": _number("model", "gain", (0.95, 1.05)),
    "A of the plant alone": _number("plant", "A"),
    "losses": _one_of("network", "mansd", (0, 1, 2, 3, 5, 6)),
    "the threshold": _number("trigger", "beta floor"),
    "times": _number("certificate", "late_periods network_delay_s", (0, 1, 2)),
    "no filter": _one_of("observer", "kind", ("luenberger", "none")),
}  # fmt: skip


def changed_scenario(name: str, change: str, rng: Rng) -> Tables:
    tables = copy.deepcopy(base(name).tables)
    SCENARIOS[change](tables, rng)
    return tables


@pytest.mark.parametrize(
    ("name", "count", "seconds"),
    [
        ("by gains", 8, 0.1),
        pytest.param("by gains", 160, _SECONDS, marks=pytest.mark.deep),
        pytest.param("by forms", 100, _SECONDS, marks=pytest.mark.deep),
    ],
)
def test_changed_scenarios_make_nothing_false_proven(name: str, count: int, seconds: float) -> None:
    of, rng = base(name), np.random.default_rng(count)
    old, W = prove_statement(of.loop, of.document), floats(of.loop.weight)
    noise, rate = noise_of(of.loop, old.rate), float(old.rate)
    assert share_of_error(true_errors(of.tables, of.loop, old, seconds=seconds), noise, rate, W) > _NEAR
    tried, true, others = 0, 0, 0
    for change in itertools.cycle(SCENARIOS):
        tables = changed_scenario(name, change, rng)
        if tables == of.tables:
            continue
        tried += 1
        if (found := proven(tables, of.document)) is not None:
            true += 1
            errors = true_errors(tables, *found, seconds=seconds)
            others += share_of_error(errors, noise, rate, W) > 1
        if tried == count:
            break
    assert min(true, tried - true) > count // 16
    if name == "by gains":  # what was proven before is false of some
        assert others > count // 8


# Changed witnesses.


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("by gains", 8),
        pytest.param("by gains", 70, marks=pytest.mark.deep),
        pytest.param("by forms", 80, marks=pytest.mark.deep),
    ],
)
def test_changed_documents_prove_nothing_false(name: str, count: int) -> None:
    of, rng, rejected = base(name), np.random.default_rng(count), 0
    changes = [*(GAINS if name == "by gains" else DOCUMENTS).values()]
    proofs = [prove_statement(of.loop, of.document)]
    for k in range(count):
        document = copy.deepcopy(of.document)
        changes[k % len(changes)](document, rng)
        proof = accepted(of.loop, document)
        rejected += proof is None
        proofs += [] if proof is None else [proof]
    require_true(of.loop, proofs, 3)
    errors = errors_of(of.tables)
    for rate in {float(proof.rate) for proof in proofs}:
        assert share_of_error(errors, noise_of(of.loop, number(rate)), rate, floats(of.loop.weight)) <= 1
    assert min(rejected, len(proofs)) > count // 8


@pytest.mark.parametrize("count", [40, pytest.param(240, marks=pytest.mark.deep)])
def test_any_part_of_the_error_that_decays_smoothly_leaves_a_bound_of_the_rest(count: int) -> None:
    """A document names it, and nothing of it has to be right."""
    of, rng = base("by gains"), np.random.default_rng(count)
    errors, W = errors_of(of.tables), floats(of.loop.weight)
    start, F = errors[0][1], np.diag([-2.0, -5.0])
    shares = []
    for _ in range(count):
        q = int(rng.integers(1, 4))
        S, Λ = rng.normal(size=(2, q)), np.zeros((q, q)) - np.diag(rng.uniform(0.0, 9.0, q))
        s = 10.0 ** rng.integers(-3, 1) * rng.normal(size=(q, 1))
        if q == 2 and rng.random() < 0.5:
            S, Λ, s = (
                np.eye(2),
                F + 0.5 * rng.normal(size=(2, 2)),
                start[:, None] * rng.uniform(0.8, 1.2, (2, 1)),
            )
        table = {"columns": S.tolist(), "rates": Λ.tolist(), "start": s.tolist()}
        rate = float(rng.choice([0.0, 0.1, 0.4]))
        try:
            noise = read_assumptions(of.loop, number(rate), {"observer": table, "later": 0}).noise
        except RejectedError:
            continue
        assert noise is not None
        shares.append(share_of_error(errors, noise, rate, W))
    assert max(shares) <= 1 + _ROUNDING
    assert len(shares) > count // 2
    assert len(set(shares)) > count // 4
