"""Loops about a reference: how they are read, what is proven of them, and that runs keep it."""

import copy
from itertools import product
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from cosim.simulation.virtual_time import simulate
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.scenario import read_loop
from noack.proof.statement_proof import prove_statement
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.certificates.proven_bounds import ProvenBounds
from noack.theory.witnesses.documents import witness_by_gains
from noack.theory.witnesses.gains import find_by_gains
from noack.theory.witnesses.outward import proven_bounds
from tests.checker.completed import completed
from tests.checker.loops import SERVO, loop_with, servo
from tests.checker.proofs import Proved, proved
from tests.checker.runs import floats
from tests.helpers.bound_shares import share_of_bound
from tests.helpers.shipped import resolved, shipped


@pytest.fixture(scope="module")
def statement() -> Proved:
    return proved("servo_reference")


def changed(key: str, row: int, column: int, factor: float, segment: int = 4) -> dict[str, Any]:
    tables = copy.deepcopy(servo())
    tables["controller"]["reference"][segment][key][row][column] *= factor
    return tables


def test_disturbances_are_those_of_the_reference() -> None:
    """The largest values at sampled times are at most what is enclosed, and nearly as large."""
    scenario = resolved(SERVO)
    loop = read_loop(servo(), box=False, ideal=False)
    reference, own = loop_of(scenario).reference, loop_of(scenario)
    assert reference is not None
    t_ns = np.arange(0, 16_000_000_000, 2_000_000)
    rows = reference.rows(t_ns)
    mismatch = np.abs(rows[:, 2:] @ (own.B - own.B_model).T).max(axis=0)
    age_s = float(arb(loop.times.age))
    shifted = reference.rows(np.maximum(t_ns - round(age_s * 1e9), 0))
    held = np.abs(own.B @ (shifted[:, 2:] - rows[:, 2:]).T).max()
    pushes = np.abs(floats(loop.pushes))
    columns = {tuple(column > 1e-6): column for column in pushes.T}
    assert len(columns) == 2  # one of them is rounding
    sizes = sorted(pushes[1])[-2:]
    for size, least in zip(sizes, sorted([held, mismatch[1]]), strict=True):
        assert least <= size < 1.3 * least
    assert 0 < float(loop.offset.mid()) < 1e-12


def test_a_reference_that_is_exact_needs_no_offset() -> None:
    """x_r = (0, 0) and (1, 0) are exact solutions; a jump to the second one ends the statement."""
    steps = (f'{{kind="step",output="angle",value={k},from_s={3 * k}}}' for k in (0, 1))
    loop = read_loop(servo(f"controller.reference=[{','.join(steps)}]"), box=False, ideal=False)
    assert loop.offset == 0
    assert loop.until == 3
    assert loop.pushes.ncols() == 0


def test_the_input_is_not_u_r_before_the_first_one_acts() -> None:
    ramp = '[{kind="ramp",output="angle",rate_per_s=0.3,value=0.0,from_s=0.0}]'
    loop = loop_with(servo(f"controller.reference={ramp}", "plant.initial_state=[0.0,0.3]"), box=False)
    assert loop.push_before_input is not None
    gain = floats(loop.B)[1, 0]
    assert floats(loop.push_before_input)[:, 0] == pytest.approx([0.0, -gain * 0.15])  # u_r = 2 · 0.3/4
    assert floats(loop.start)[:, 0] == pytest.approx([0.0, 0.0], abs=1e-12)


def test_the_angle_has_a_proven_bound(statement: Proved) -> None:
    assert statement.bounds.bounds["y[0]"].constant < 0.03
    assert not statement.bounds.limits  # nothing is known after the end of the reference


def share_of_distance(chosen: Scenario, bounds: ProvenBounds) -> float:
    """Return the largest share of the bound that the angle's distance from its reference uses in a run."""
    reference = loop_of(chosen).reference
    assert reference is not None
    rows = simulate(chosen)[PLANT_STEP]
    t_ns = np.asarray(rows["t_ns"])
    return share_of_bound(bounds, "y[0]", t_ns, (rows["x"] - reference.states(t_ns))[:, 0])


def test_no_simulated_run_exceeds_it(statement: Proved) -> None:
    """The runs are those of noack's machines, with the true plant at an end of its range."""
    largest = 0.0
    for loss, gain in product((0.0, 0.5, 1.0), (3.8, 4.2)):
        settings = ("plant.draw=given", "plant.A=[[0.0,1.0],[0.0,-2.0]]", f"plant.B=[[0.0],[{gain}]]")
        chosen = resolve(shipped(SERVO, *settings, f"network.loss.probability={loss}"))
        largest = max(largest, share_of_distance(chosen, statement.bounds))
    assert 0.3 < largest <= 1.0


@pytest.mark.parametrize(
    ("key", "row", "column", "factor"),
    [
        ("u", 0, 0, 4.0),  # no solution of the model: what is missing pushes the plant
        ("x", 1, 0, 2.0),
    ],
)
def test_the_bound_is_none_of_another_reference(
    statement: Proved, key: str, row: int, column: int, factor: float
) -> None:
    loop = loop_with(changed(key, row, column, factor))
    with pytest.raises(RejectedError, match=r"at motion/0 lost/"):
        prove_statement(loop, completed(loop, statement.document))


def test_a_jump_ends_the_statement_before_it() -> None:
    assert loop_with(changed("x", 0, 0, 1.5)).until == fmpq(11, 2)
    assert loop_with(servo()).until == 16


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ("plant.uncertainty_B=[[0.0],[0.6]]", "motion/0 lost/"),  # the mismatch about the reference is larger
        ("controller.rate_hz=50", "motion/0 lost/"),  # an input is held for longer
        ("plant.initial_state=[0.9,0.0]", "start$"),
        (
            'controller.reference=[{kind="sine",output="angle",amplitude=3.0,hz=0.3,from_s=1.0,join_s=2.0}]',
            "motion/0 lost/",
        ),
    ],
)
def test_the_bound_is_none_of_a_worse_loop(statement: Proved, setting: str, reason: str) -> None:
    loop = loop_with(servo(setting))
    with pytest.raises(RejectedError, match=f"at ({reason})"):
        prove_statement(loop, completed(loop, statement.document))


def test_an_older_input_differs_by_more() -> None:
    """A run that is late has a loop with its own age of inputs."""
    short, long = (floats(loop_with(servo(), age=fmpq(age, 1000)).pushes) for age in (7, 28))
    assert np.abs(long[:, 0]) == pytest.approx(4 * np.abs(short[:, 0]), rel=1e-6)


def test_a_bound_in_the_limit_is_rejected(statement: Proved) -> None:
    document = copy.deepcopy(statement.document)
    document["bounds"][0]["from_start"] = False
    with pytest.raises(RejectedError, match="no bound in the limit"):
        prove_statement(loop_with(servo()), document)


def test_the_offset_of_joined_pieces_is_added(statement: Proved) -> None:
    loop = loop_with(servo())
    near, far = (prove_statement(loop._replace(offset=arb(size)), statement.document) for size in (0.0, 0.25))
    constants = [
        [float(b.constant.mid()) for b in proof.bounds if b.output[0] in "xy"] for proof in (near, far)
    ]
    assert np.diff(constants, axis=0)[0] == pytest.approx(0.25, rel=1e-3)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"from_s": 0.5}, "begins at 0"),
        ({"kind": "step"}, "kind"),
        ({"x": [[0.0]]}, "2 numbers"),
        ({"u": [[0.0], [0.0]]}, "as many coefficients"),
        ({"hz": [1.0]}, "missing"),
        ({"value": 1.0}, "not resolved"),
    ],
)
def test_wrong_segments_are_refused(changes: dict[str, object], message: str) -> None:
    tables = copy.deepcopy(servo())
    tables["controller"]["reference"][0] |= changes
    with pytest.raises(RefusedError, match=message):
        read_loop(tables, box=False, ideal=False)


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ('trigger={policy="mixed",sigma=0.05,epsilon=0.01}', "compares with x"),
        ("model.gain=[[3.0,1.25]]", "not stable"),
    ],
)
def test_what_is_not_covered_is_refused(setting: str, message: str) -> None:
    with pytest.raises(RefusedError, match=message):
        read_loop(servo(setting, "model.allow_unstable=true"), box=False, ideal=False)


def test_a_loop_with_an_observer_is_about_its_reference() -> None:
    observed = ("plant.measurement.C=[[1.0,0.0]]", 'observer={kind="luenberger",poles_per_s=[-12.0,-15.0]}')
    settings = (*observed, "plant.draw=given", "plant.A=[[0.0,1.0],[0.0,-2.0]]", "plant.B=[[0.0],[4.0]]")
    loop = read_loop(servo(*settings), box=False, ideal=False)
    bounds, largest = proven_bounds(witness_by_gains(loop, ("x", "y[0]")).proof, loop), 0.0
    for seed in range(2):
        chosen = resolve(shipped(SERVO, *settings, "network.loss.probability=1.0", f"seeds.loss={seed}"))
        largest = max(largest, share_of_distance(chosen, bounds))
    assert 0.05 < largest <= 1.0


def test_gains_have_neither_the_input_nor_a_limit_about_a_reference() -> None:
    loop = read_loop(servo(), box=False, ideal=False)._replace(push_before_input=None)
    document: Any = find_by_gains(loop, ("x", "y[0]"))
    proof = prove_statement(loop, document)
    assert {bound.from_start for bound in proof.bounds} == {True}
    assert not prove_statement(loop._replace(until=None), document).bounds[-1].from_start
    with pytest.raises(RejectedError, match="outputs: about a reference"):
        prove_statement(loop, {**document, "gains": {**document["gains"], "outputs": ["x", "u[0]"]}})
