"""Loops with unknown constant loads: how they are read, what is proven of them, and that runs keep it."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.witnesses import resolved_content
from cosim.simulation.virtual_time import simulate
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.scenario import read_loop
from noack.proof.files import document_of
from noack.proof.loop_document import Naming
from noack.proof.statement_proof import prove_statement
from noack.protocol.record_tables import PLANT_STEP
from noack.scenario.resolution import resolve
from tests.checker.completed import completed
from tests.checker.proofs import Proved, proved
from tests.checker.runs import floats
from tests.helpers.bound_shares import share_of_bound
from tests.helpers.resolved_tables import resolved_tables
from tests.helpers.shipped import resolved, shipped

MOTOR = "dc_motor_load"


def motor(*settings: str) -> dict[str, Any]:
    return dict(resolved_content(resolved(MOTOR, *settings)))


@pytest.fixture(scope="module")
def statement() -> Proved:
    return proved("dc_motor_load")


def test_a_loop_is_read_about_its_rest() -> None:
    loop = read_loop(motor(), box=False, ideal=False)
    assert loop.fault() == ""
    assert loop.loads == 1
    assert floats(loop.start)[:, 0] == pytest.approx([1.0, 0.0, 0.0])
    # At rest the voltage holds the load, 309.75 · 0.2 / 2121.8; without an input it pushes the shaft.
    assert loop.push_before_input is not None
    assert floats(loop.push_before_input)[:, 0] == pytest.approx([0.0, 309.75 * 0.2, 0.0])


def test_the_rest_of_a_load_that_the_input_cannot_cancel_is_the_start_of_the_coordinates() -> None:
    mass = (
        "model={A=[[0.0,1.0,0.0],[0.0,0.0,1.0],[0.0,0.0,-5.0]], B=[[0.0],[0.0],[5.0]], "
        'gain=[[-1.0,-2.0,-1.0]], state_names=["s","v","f"], load=[[0.0],[1.0],[0.0]], hold=["s"]}',
        "plant={initial_state=[1.0,0.0,0.0], load=[0.3]}", "trigger={beta=0.5,alpha_per_s=0.1,floor=0.01}",
    )  # fmt: skip
    tables = resolved_tables("double_integrator", *mass)
    loop = read_loop(tables, box=False, ideal=False)
    # The force f = −0.3 holds the load; x − x at rest is (1, 0, 0.3).
    assert floats(loop.start)[:, 0] == pytest.approx([1.0, 0.0, 0.3, 0.0])


def test_a_loop_with_a_reference_is_read_about_its_rest_and_the_reference() -> None:
    step = '{kind="step",output="shaft_angle",value=0.5,from_s=0.0}'
    loop = read_loop(motor(f"controller.reference=[{step}]"), box=False, ideal=False)
    assert loop.fault() == ""
    assert floats(loop.start)[:, 0] == pytest.approx([0.5, 0.0, 0.0])
    assert loop.push_before_input is not None  # the motor rests at 0.5 rad without a voltage
    assert floats(loop.push_before_input)[:, 0] == pytest.approx([0.0, 309.75 * 0.2, 0.0])
    assert loop.until is None  # it is a set-point


def test_what_the_load_pushes_before_the_first_input_moves_the_state_and_the_sensors_error(
    statement: Proved,
) -> None:
    corners = []
    for loop in (statement.loop, statement.loop._replace(push_before_input=None)):
        table = document_of(loop, statement.document, Naming("a motor")).table
        names = [coordinate["name"] for coordinate in table["coordinates"]]
        corners += table["motions"]["without input"]
    with_load, at_rest = corners
    (push,) = with_load["unknown"]
    assert at_rest["unknown"] == []
    moved = {
        name: float(np.mean(entry)) for name, (entry,) in zip(names, push["column"], strict=True) if entry
    }
    size = float(push["rows"][0][names.index("f2")])
    assert {name: size * entry for name, entry in moved.items()} == {
        "x1": pytest.approx(309.75 * 0.2), "e x1": pytest.approx(-309.75 * 0.2),
    }  # fmt: skip


def test_a_larger_push_before_the_first_input_is_not_covered(statement: Proved) -> None:
    push = statement.loop.push_before_input
    assert push is not None
    with pytest.raises(RejectedError, match="all states: not proven at motion/start, 0 later/"):
        prove_statement(statement.loop._replace(push_before_input=3 * push), statement.document)


def test_a_load_that_changes_is_refused() -> None:
    with pytest.raises(RefusedError, match="a constant one"):
        read_loop(motor("plant.load_changes=[{at_s=1.0,load=[0.1]}]"), box=False, ideal=False)


def test_loads_that_do_not_stay_constant_are_refused() -> None:
    tables = motor()
    for table in ("model", "plant"):
        tables[table]["A"][2] = [0.1, *tables[table]["A"][2][1:]]
    with pytest.raises(RefusedError, match="not constant"):
        read_loop(tables, box=False, ideal=False)


@pytest.mark.parametrize("mode", ["model", "zoh"])
def test_a_model_that_differs_from_the_plant_does_not_rest_with_it(mode: str) -> None:
    tables = motor(f'mode="{mode}"')
    del tables["observer"]
    tables["plant"]["measurement"] = {"C": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]}
    known = {**tables, "network": {**tables["network"], "initial_sync": "known_state"}}
    with pytest.raises(RefusedError, match='known_state": not covered with loads'):
        read_loop(known, box=False, ideal=False)  # no process knows the load
    assert read_loop(tables, box=False, ideal=False).fault() == ""
    tables["plant"]["A"][1][1] *= 1.3
    if mode == "zoh":
        assert read_loop(tables, box=False, ideal=False).fault() == ""
        return
    with pytest.raises(RefusedError, match="differs"):
        read_loop(tables, box=False, ideal=False)


@pytest.mark.parametrize(
    "trigger", [{"policy": "relative", "sigma": 0.1}, {"policy": "mixed", "sigma": 0.1, "epsilon": 0.1}]
)
def test_a_rule_that_compares_x_is_rejected_with_loads(trigger: dict[str, Any]) -> None:
    """Where the loop rests x is not 0, so events come later than about 0."""
    tables = motor()
    tables["trigger"] = trigger
    assert read_loop(tables, box=False, ideal=False).fault() == (
        "loads: the rule compares x, which is not 0 where the loop rests"
    )


def test_the_shaft_has_a_proven_bound(statement: Proved) -> None:
    bound = statement.bounds.bounds["y[0]"]
    assert bound.constant < 0.1
    assert statement.bounds.inter_event_s is not None
    assert statement.bounds.inter_event_s > 0.004


def test_the_input_is_no_output_of_a_loop_about_its_rest(statement: Proved) -> None:
    """It is not 0 at rest, nor what the forms have before the first one acts."""
    (first, *_), document = statement.document["bounds"], statement.document
    with pytest.raises(RejectedError, match=r"^u: about a reference, or where the loop rests"):
        prove_statement(statement.loop, {**document, "bounds": [{**first, "output": "u[0]"}]})


def test_no_simulated_run_exceeds_it(statement: Proved) -> None:
    """The runs are those of noack's machines, of which the checker has nothing."""
    largest = 0.0
    losses = [f"network.loss.probability={p}" for p in (0.0, 0.3, 0.6, 1.0)]
    for seed in range(2):
        for loss in losses:
            run = simulate(resolve(shipped(MOTOR, loss, f"seeds.loss={seed}")))
            rows = run[PLANT_STEP]
            largest = max(largest, share_of_bound(statement.bounds, "y[0]", rows["t_ns"], rows["x"][:, 0]))
    assert 0.3 < largest <= 1.0


def test_the_bound_is_none_of_a_larger_load(statement: Proved) -> None:
    larger = read_loop(motor("plant.load=[2.0]"), box=False, ideal=False)
    with pytest.raises(RejectedError, match=r"at motion/start, "):
        prove_statement(larger, completed(larger, statement.document))


def test_the_bound_is_none_of_a_slower_observer(statement: Proved) -> None:
    tables = motor()
    tables["observer"]["gain"][2] = [entry / 10 for entry in tables["observer"]["gain"][2]]
    loop = read_loop(tables, box=False, ideal=False)
    with pytest.raises(RejectedError, match=r"at edge/0 lost, "):
        prove_statement(loop, completed(loop, statement.document))
