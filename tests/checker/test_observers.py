"""The error of an observer: its bounds, the loops that they are for, and documents that prove nothing."""

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq
from scipy.linalg import expm

from noack.core.balls import matrix, number, zeros
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop, Noise, Smooth
from noack.proof.elaborate.noise import noise_of
from noack.proof.elaborate.scenario import read_loop
from noack.proof.statement_proof import prove_statement
from noack.theory.witnesses.assumptions import smooth_part
from tests.checker.completed import completed
from tests.checker.loops import OBSERVED, OBSERVED_OUTPUT
from tests.checker.proofs import Proved, proved
from tests.checker.rejections import rejects
from tests.checker.runs import exceeded, floats
from tests.helpers.resolved_tables import resolved_tables

RATE = number(0.3)
C = OBSERVED_OUTPUT
LOOP = OBSERVED
PUSHED = LOOP._replace(pushes=matrix([[0.0], [1.0]]), sizes=(arb(0.05),), weight=matrix([[2, 0], [1, 1]]))


def filtered(loop: Loop, radius: float = 0.0, count: int = 40) -> Loop:
    """Return the loop with gains that begin larger and of which only balls are known."""
    assert loop.observer is not None
    (last,) = loop.observer.gains
    shares = [0.85**k for k in range(count)]
    gains = [last + (matrix([[1.0], [5.0]]) - last) * number(share) for share in shares]
    blur = matrix([[1.0], [5.0]]) * arb(0, radius)
    return loop._replace(
        observer=loop.observer._replace(gains=(*(gain + blur for gain in gains), last + blur))
    )


FILTERED = filtered(PUSHED, 1e-6)


@pytest.fixture(scope="module")
def witness() -> Proved:
    return proved("observed")


# The bounds of the error.


def simulated_errors(loop: Loop, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return x̂ − x at tests, from runs of the error with the largest noise and disturbances."""
    assert loop.observer is not None
    T = float(loop.observer.period.p) / float(loop.observer.period.q)
    A, noise, balls = floats(loop.A), floats(loop.noise), loop.observer.gains
    exact = [float(entry.rad()) for gain in balls for entry in gain.entries()]
    gains = [floats(gain) for gain in balls]
    if any(exact):  # some of the gains within the balls
        moved = rng.choice([-1.0, 1.0], (len(gains), loop.n, noise.shape[0]))
        radii = np.array(exact).reshape(moved.shape)
        gains = [*(np.array(gains) + moved * radii)]
    pushes = floats(loop.pushes) * np.array([float(size.mid()) for size in loop.sizes])
    n = loop.n
    whole = expm(np.block([[A, np.eye(n)], [np.zeros((n, 2 * n))]]) * T)
    Ad, Gd = whole[:n, :n], whole[:n, n:]
    o, found, turn = floats(loop.observer.start)[:, 0], [], int(rng.integers(1, 60))
    signs = [rng.choice([-1.0, 1.0], M.shape[1]) for M in (noise, pushes)]
    for k in range(count):
        if k % turn == turn - 1:
            signs = [-sign for sign in signs]
        predicted = Ad @ o - Gd @ (pushes @ signs[1]) if k else o
        L = gains[min(k, len(gains) - 1)]
        o = predicted + L @ (noise @ signs[0] - C @ predicted)
        found.append(o)
    return np.array(found)


def largest_share(loop: Loop, bounds: Noise, rate: float, errors: np.ndarray) -> float:
    """Return the largest share of the bounds that W n reaches in an entry, or ‖W n‖."""
    assert loop.observer is not None
    T = float(loop.observer.period.p) / float(loop.observer.period.q)
    W, (columns, rates, start) = floats(loop.weight), map(floats, bounds.smooth)
    sides = np.abs(W @ floats(bounds.columns))
    found = []
    for k, error in enumerate(errors):
        f1 = np.exp(-rate * k * T)
        rest = error - (columns @ expm(rates * k * T) @ start)[:, 0] if len(rates) else error
        box = sides[:, : bounds.decaying].sum(axis=1) * f1 + sides[:, bounds.decaying :].sum(axis=1)
        norm = float(bounds.sizes[0].mid()) * f1 + float(bounds.sizes[1].mid())
        found += [*(np.abs(W @ rest) / box), float(np.linalg.norm(W @ error)) / norm]
    return max(found)


def smooth_of(loop: Loop, faster: float = 1.0) -> Smooth:
    assert loop.observer is not None
    found = smooth_part(loop._replace(observer=loop.observer._replace(gains=loop.observer.gains[-1:])))
    assert found is not None
    columns, rates, start = (np.array(found[name]) for name in ("columns", "rates", "start"))
    return Smooth(*(matrix(M.tolist()) for M in (columns, rates * faster, start)))


@pytest.mark.parametrize("loop", [LOOP, PUSHED, FILTERED], ids=["plain", "pushed", "filtered"])
@pytest.mark.parametrize("part", ["none", "its own", "another"])
def test_errors_stay_within_their_bounds_and_come_near(loop: Loop, part: str) -> None:
    smooth = {"none": None, "its own": smooth_of(loop), "another": smooth_of(loop, 1.1)}[part]
    bounds = noise_of(loop, RATE, smooth)
    assert bounds.smooth.rates.nrows() == (0 if smooth is None else 2)
    rng = np.random.default_rng(0)
    shares = [largest_share(loop, bounds, 0.3, simulated_errors(loop, rng, 400)) for _ in range(6)]
    assert max(shares) <= 1 + 1e-9
    assert max(shares) > 0.7


def test_a_smooth_part_leaves_little(witness: Proved) -> None:
    bounds = [noise_of(LOOP, RATE, smooth) for smooth in (None, smooth_of(LOOP))]
    assert bounds[0].decaying == 2
    assert bounds[1].decaying == 0  # it is added to the constant bounds
    assert float(bounds[1].columns[1, 1].mid()) < 1.02 * float(bounds[0].columns[1, 3].mid())
    assert "observer" in witness.document


@pytest.mark.parametrize("rate", [8.5, 1000.0])
def test_bounds_do_not_decay_faster_than_the_error(rate: float) -> None:
    with pytest.raises(RejectedError, match="observer: its error"):
        noise_of(LOOP, number(rate))
    slow = smooth_of(LOOP)._replace(rates=matrix([[-0.2, 0.0], [0.0, -0.2]]))
    with pytest.raises(RejectedError, match="observer: its error"):
        noise_of(LOOP, RATE, slow)


def test_gains_that_change_for_too_long_are_rejected(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("noack.proof.elaborate.noise._MOST_ENTRIES", 1000)
    with pytest.raises(RejectedError, match="change for too long"):
        noise_of(filtered(PUSHED), RATE)


def test_gains_of_which_little_is_known_are_rejected() -> None:
    with pytest.raises(RejectedError, match="not known well enough"):
        noise_of(filtered(PUSHED, 0.1), RATE)


def test_an_observer_that_does_not_decay_is_rejected() -> None:
    assert LOOP.observer is not None
    useless = LOOP._replace(observer=LOOP.observer._replace(gains=(zeros(2, 1),)))
    with pytest.raises(RejectedError, match="observer: its error"):
        noise_of(useless, arb(0))


def test_at_rate_0_all_bounds_are_constant() -> None:
    bounds = noise_of(LOOP, arb(0))
    assert bounds.decaying == 0
    assert bounds.sizes[0] == 0
    rng = np.random.default_rng(1)
    assert largest_share(LOOP, bounds, 0.0, simulated_errors(LOOP, rng, 400)) <= 1


FOUR_STATES = (
    "model={A=[[1.27025,-0.39836,0.0589018,-2.10487],[-0.823096,0.666567,0.504427,-0.817716],"
    "[0.428062,-0.916517,-0.899377,-2.30207],[0.357575,0.51807,0.731872,1.44108]],"
    "B=[[-0.56758],[-0.740994],[-0.346462],[-0.460969]],gain=[[-9.286317,6.127737,3.019875,11.424124]]}",
    "plant={initial_state=[0.5,-1.0,-0.1,-0.7],"
    "measurement={C=[[1.89763,0.860966,-0.0290367,0.0649595]],noise_bound=[1e-6]}}",
    'observer={kind="luenberger",poles_per_s=[-10.0,-13.0,-16.0,-19.0]}',
)  # fmt: skip


def test_a_smooth_part_with_rounding_is_found_without_a_warning() -> None:
    """A warning would be an error here: scipy doubts the logarithm, which need not be right."""
    loop = read_loop(resolved_tables("double_integrator", *FOUR_STATES), box=False, ideal=False)
    assert np.linalg.eigvals(floats(smooth_of(loop).rates)).real.max() == pytest.approx(-10.0, abs=1e-3)


# The model.


def test_the_smooth_part_flows_and_is_in_the_error_after_an_event() -> None:
    smooth = smooth_of(LOOP)
    model = Model(LOOP, RATE, number(0.8), None, noise_of(LOOP, RATE, smooth), later=1)
    rng, n = np.random.default_rng(0), 2
    for place in model.locations:
        z = rng.normal(size=model.size)
        moved = floats(place.flows[0].matrix) @ z
        x, e, s = (floats(rows) for rows in (model.x, model.e, model.s))
        assert s @ moved == pytest.approx(floats(smooth.rates) @ (s @ z))
        # x_s = x + e moves by its model alone.
        assert (x + e) @ moved == pytest.approx(floats(LOOP.H) @ (x + e) @ z)
        assert moved[:n] == pytest.approx(x @ moved)
    edges = {edge.name: edge for edge in model.edges}
    for name in ("0 lost, sent", "0 lost, lost", "0 later, event"):
        z = rng.normal(size=model.size)
        after = floats(edges[name].jump) @ z
        noise = floats(smooth.columns) @ (floats(model.s) @ z) + floats(model.bounds.columns) @ (
            floats(model.p) @ z
        )
        assert floats(model.e) @ after == pytest.approx(noise)
        assert floats(model.s) @ after == pytest.approx(floats(model.s) @ z)
        together = floats(model.x + model.e + model.w)
        assert together @ after == pytest.approx(together @ z)


def test_bounds_are_not_exceeded(witness: Proved) -> None:
    for seed in range(3):
        assert exceeded(LOOP, witness.proof, np.random.default_rng(seed), 8.0) == []


# Documents and loops.


def test_runs_from_another_estimate_exceed_the_bounds(witness: Proved) -> None:
    assert LOOP.observer is not None
    far = LOOP._replace(observer=LOOP.observer._replace(start=matrix([[-20.0], [10.0]])))
    rejects(far, completed(far, witness.document), "at edge/0 lost, sent/")
    assert any(exceeded(far, witness.proof, np.random.default_rng(seed), 4.0) for seed in range(3))


CHANGES: dict[str, Callable[[Loop], Loop]] = {
    "another plant": lambda loop: loop._replace(B=loop.B * number(0.9)),
    "a box": lambda loop: loop._replace(half_B=matrix([[0.0], [0.1]])),
    "no tests": lambda loop: loop._replace(
        times=loop.times._replace(sampling=fmpq(0), least_sampling=fmpq(0))
    ),
    "no period": lambda loop: loop._replace(observer=loop.observer._replace(period=fmpq(0))),  # type: ignore[union-attr]
    "a wrong shape": lambda loop: loop._replace(observer=loop.observer._replace(start=zeros(1, 1))),  # type: ignore[union-attr]
    "no gain": lambda loop: loop._replace(observer=loop.observer._replace(gains=())),  # type: ignore[union-attr]
    "noise of other outputs": lambda loop: loop._replace(noise=zeros(2, 1)),
    "another load": lambda loop: loop._replace(loads=1),
    "not finite": lambda loop: loop._replace(
        observer=loop.observer._replace(gains=(matrix([[1], [1]]) * arb("nan"),))  # type: ignore[union-attr]
    ),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_loop_that_is_none_is_rejected(witness: Proved, change: str) -> None:
    rejects(CHANGES[change](LOOP), witness.document, "^loop: ")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"columns": 1}, "^columns: not a matrix"),
        ({"columns": [[1], [0]]}, "^observer: columns, rates and start do not fit"),
        ({"rates": [[1]]}, "^observer: columns, rates and start do not fit"),
        ({"rates": [["a", 0], [0, 1]]}, "^rates: not a number"),
        ({"start": [[0.1]]}, "^observer: columns, rates and start do not fit"),
        ({"start": [0.1, 0.2]}, "^start: not a matrix"),
        ({"start": [[0.1], [0.2, 0.3]]}, "^start: rows of different lengths"),
    ],
)
def test_a_smooth_part_has_matrices_that_fit(
    witness: Proved, changes: dict[str, object], reason: str
) -> None:
    document: dict[str, Any] = copy.deepcopy(witness.document)
    document["observer"] |= changes
    rejects(LOOP, document, reason)


@pytest.mark.parametrize(
    ("value", "reason"),
    [(1, "^observer: not a table"), ([], "^observer: not a table"), ({}, "^columns: not a matrix")],
)
def test_a_smooth_part_is_a_table(witness: Proved, value: object, reason: str) -> None:
    rejects(LOOP, {**witness.document, "observer": value}, reason)


def test_a_document_without_the_smooth_part_proves_nothing(witness: Proved) -> None:
    document: dict[str, Any] = copy.deepcopy(witness.document)
    prove_statement(LOOP, document)
    del document["observer"]
    rejects(LOOP, document, "form of 0 lost: unknown matrix, or not one of this size")


def test_another_smooth_part_is_no_proof_by_the_same_forms(witness: Proved) -> None:
    document: dict[str, Any] = copy.deepcopy(witness.document)
    document["observer"]["rates"] = (np.array(document["observer"]["rates"]) * 1.5).tolist()
    rejects(LOOP, document, "at motion/0 lost/")


# The scenario.

SCENARIO = (
    'observer={kind="luenberger", poles_per_s=[-8, -10]}', "plant.measurement.C=[[1.0, 0.0]]",
    "plant.measurement.noise_bound=[0.002]", "plant.draw=given", "plant.A=[[0.0, 1.0], [0.0, 0.0]]",
    "plant.B=[[0.0], [1.0]]",
)  # fmt: skip


def test_an_observer_is_read() -> None:
    tables = resolved_tables("double_integrator", *SCENARIO)
    loop = read_loop(tables, box=False, ideal=False)
    assert loop.observer is not None
    assert [floats(gain).tolist() for gain in loop.observer.gains] == [tables["observer"]["gain"]]
    assert floats(loop.observer.outputs).tolist() == C.tolist()
    assert floats(loop.observer.start)[:, 0].tolist() == [-1.0, 0.0]
    assert floats(loop.noise).tolist() == [[0.002]]
    assert loop.observer.period == loop.times.sampling == fmpq(1, 500)


REFUSED = {
    "plant.B=[[0.0], [0.9]]": r"plant\.B",
    "network.initial_sync=known_state": "known_state",
    "plant.rate_hz=300": "with an observer the periods are whole ns",
}


@pytest.mark.parametrize("setting", REFUSED)
def test_what_is_not_covered_with_an_observer_is_refused(setting: str) -> None:
    settings = [each for each in SCENARIO if each.partition("=")[0] != setting.partition("=")[0]]
    tables = resolved_tables("double_integrator", *settings, setting)
    with pytest.raises(RefusedError, match=REFUSED[setting]):
        read_loop(tables, box=False, ideal=False)


def test_a_box_and_ideal_conditions_are_refused() -> None:
    tables = resolved_tables("double_integrator", *SCENARIO, "plant.uncertainty_B=[[0.0], [0.2]]")
    with pytest.raises(RefusedError, match=r"plant\.B"):
        read_loop(tables, box=True, ideal=False)
    with pytest.raises(RefusedError, match="observer: ideal conditions, with tests at all times"):
        read_loop(tables, box=False, ideal=True)


@pytest.mark.parametrize(
    "gain", [[[1.0]], [[1.0, 0.0], [0.0, 1.0]], [[1.0], [1.0], [1.0]], 1.0, [["1"], [1.0]]]
)
def test_a_gain_has_a_shape(gain: object) -> None:
    tables = resolved_tables("double_integrator", *SCENARIO)
    tables["observer"]["gain"] = gain
    with pytest.raises(RefusedError, match=r"observer(\.gain|: a gain has not a row for each state)"):
        read_loop(tables, box=False, ideal=False)
