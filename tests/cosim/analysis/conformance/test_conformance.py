"""Runs are runs of their loop documents, and a document with a fault is refuted by one of them."""

import copy
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.condition_reader import read_conditions
from cosim.analysis.claims.run_certificates import certificates_under
from cosim.analysis.conformance.conformance import compare
from cosim.analysis.conformance.document_numbers import DocumentNumbers
from cosim.analysis.conformance.recorded_loop import RecordedLoop
from cosim.analysis.conformance.run_conformance import conformance, conformance_with, reference_of_bounds
from cosim.analysis.conformance.run_document import RunDocument, document_of_statement
from cosim.analysis.conformance.trace import Trace, trace_of
from cosim.analysis.conformance.verdicts import Failed
from cosim.analysis.witnesses import WitnessedStatement, find_statement, plants_of
from cosim.shipped_files import shipped_names
from cosim.simulation.virtual_time import simulate
from noack.core.linear_systems import Matrix
from noack.proof.loop_document import Naming
from noack.scenario.resolution import ResolvedRun
from noack.theory.certificates.conditions import allowed_conditions
from noack.theory.witnesses.coordinates import floats
from tests.checker.loops import FILTERED_MASS
from tests.checker.proofs import proved
from tests.cosim.simulation.late_plant import late_run
from tests.helpers.shipped import resolved, shipped

Table = dict[str, Any]
Change = Callable[[Table], None]
HORIZON_S = 6.0
LINEAR = ("double_integrator", "unstable_pendulum")


def document_of_scenario(name: str) -> RunDocument:
    statement = find_statement(resolved(name), "own", "schedule", most_work=0.0)
    return document_of_statement(statement, Naming(name))


@pytest.fixture(scope="module", params=LINEAR)
def traced(request: pytest.FixtureRequest) -> tuple[Trace, Table]:
    """Return the trace of a simulated run with all losses that are allowed, and its document."""
    record = simulate(resolved(request.param, f"horizon_s={HORIZON_S}"))
    document = document_of_scenario(request.param)
    return trace_of(RecordedLoop(record), document), document.table


def test_a_run_is_a_run_of_its_document(traced: tuple[Trace, Table]) -> None:
    found = compare(traced[0], DocumentNumbers(traced[1]))
    assert found.conforms, found.failure
    assert sum(count > 0 for count in found.edges.values()) >= len(found.edges) - 2
    assert max(found.clocks.values()) == pytest.approx(1.0)


def corners(document: Table) -> list[Table]:
    found: list[Table] = document["motions"]["driven"]
    return found


def scaled(value: Any, factor: float) -> Any:
    return [scaled(each, factor) for each in value] if isinstance(value, list) else factor * float(value)


def numbers(rows: list[list[Any]]) -> Matrix:
    """Return a matrix of a document, of intervals their middles."""
    return np.array(
        [[np.mean([float(Fraction(v)) for v in np.ravel(entry)]) for entry in row] for row in rows]
    )


def push_harder(document: Table) -> None:
    """B is 1 % larger: so is the share of u in ẋ, and less in ė."""
    for corner in corners(document):
        B = np.zeros((len(corner["matrix"]), 1))
        B[1], B[3] = 0.01, -0.01
        corner["matrix"] = (numbers(corner["matrix"]) + B @ numbers(corner["input"])).tolist()


def lose_fewer(document: Table) -> None:
    """The location of the last loss is left out."""
    last = max(edge["to"] for edge in document["edges"] if edge["name"].endswith("lost, lost"))
    document["edges"] = [edge for edge in document["edges"] if edge["to"] != last]


def lower_the_threshold(document: Table) -> None:
    document["rows"]["level"] = scaled(document["rows"]["level"], 0.99)


def raise_the_threshold(document: Table) -> None:
    document["rows"]["level"] = scaled(document["rows"]["level"], 1.1)


def arrive_sooner(document: Table) -> None:
    """Updates are on their way for a third of the time: less than in the run."""
    for location in document["locations"]:
        if location["name"] == "0 later":
            location["clock"] /= 6
    for edge in document["edges"]:
        if edge["from"] == "0 later":
            edge["when"] = [0, edge["when"][1] / 6]


def leave_out_an_edge(document: Table) -> None:
    document["edges"] = [edge for edge in document["edges"] if edge["name"] != "1 lost, lost"]


def end_the_document(document: Table) -> None:
    """The document says nothing of what follows a second loss: a run must not have one."""
    for edge in document["edges"]:
        if edge["name"] == "1 lost, lost":
            edge["to"] = None


def read_no_state(document: Table) -> None:
    """The document does not say what the record shows of z."""
    del document["readings"]["x"]


def check_more_often(document: Table) -> None:
    """A test comes earlier than it does."""
    for location in document["locations"]:
        if location["name"].endswith("lost"):
            location["clock"] /= 2
    for edge in document["edges"]:
        if edge["from"].endswith("lost"):
            edge["when"] = [0, edge["when"][1] / 2]


def keep_inputs_fresh(document: Table) -> None:
    """Inputs have no age: they are K x_c at all times."""
    document["motions"]["driven"] = corners(document)[:1] * 1


def forget_what_was_missed(document: Table) -> None:
    """An update that is lost leaves w as it was."""
    index = [coordinate["name"] for coordinate in document["coordinates"]]
    for edge in document["edges"]:
        if edge["name"].endswith("lost, lost"):
            for row, name in enumerate(index):
                if name.startswith("w "):
                    edge["jump"][row] = [int(row == column) for column in range(len(index))]


def start_elsewhere(document: Table) -> None:
    document["start"]["columns"][0] = scaled(document["start"]["columns"][0], 1.01)


REFUTED: dict[Change, set[Failed]] = {
    push_harder: {Failed.MOTION},
    lose_fewer: {Failed.EDGE},
    lower_the_threshold: {Failed.FACT},
    raise_the_threshold: {Failed.FACT},
    arrive_sooner: {Failed.WHEN, Failed.LIMIT},
    leave_out_an_edge: {Failed.EDGE},
    end_the_document: {Failed.EDGE},
    read_no_state: {Failed.READING},
    check_more_often: {Failed.LIMIT, Failed.CLOCK},
    keep_inputs_fresh: {Failed.MOTION, Failed.INPUT},
    forget_what_was_missed: {Failed.JUMP},
    start_elsewhere: {Failed.JUMP},
}


@pytest.mark.parametrize("change", REFUTED, ids=lambda change: change.__name__)
def test_a_document_with_a_fault_is_refuted(traced: tuple[Trace, Table], change: Change) -> None:
    trace, document = traced[0], copy.deepcopy(traced[1])
    change(document)
    found = compare(trace, DocumentNumbers(document))
    assert not found.conforms
    assert found.until_s < HORIZON_S
    assert found.failure is not None
    assert found.failure.kind in REFUTED[change], found.failure


def leave_out_a_step(trace: Trace) -> None:
    """One motion leads over two steps."""
    at = int(np.flatnonzero(trace.is_motion[101:])[0]) + 101
    for name in ("items", "is_motion", "is_sampled", "steps", "clocks_ns", "rows"):
        setattr(trace, name, np.delete(getattr(trace, name), at))


def forget_a_state(trace: Trace) -> None:
    trace.rows[700] = -1


def end_early(trace: Trace) -> None:
    for name in ("items", "is_motion", "is_sampled"):
        setattr(trace, name, getattr(trace, name)[:101])
    for name in ("steps", "clocks_ns", "rows"):
        setattr(trace, name, getattr(trace, name)[:102])


def change_a_state(trace: Trace) -> None:
    trace.z[500, 0] *= 1.0001


def change_an_input(trace: Trace) -> None:
    trace.u[np.flatnonzero(trace.is_motion)[200]] *= 1.01


def leave_out_the_states(trace: Trace) -> None:
    """The record seems to have no state at a step."""
    trace.is_recorded[300] = False


def change_the_sensors_model(trace: Trace) -> None:
    after = np.flatnonzero(trace.is_motion) + 1
    at = after[np.isfinite(trace.readings["x_s"][after, 0])]
    trace.readings["x_s"][at[len(at) // 2]] *= 1.001


def change_the_controllers_model(trace: Trace) -> None:
    before = np.flatnonzero(trace.is_motion)
    at = before[np.isfinite(trace.readings["x_c"][before, 0])]
    trace.readings["x_c"][at[len(at) // 2]] *= 1.001


def lose_the_sensors_model(trace: Trace) -> None:
    after = np.flatnonzero(trace.is_motion) + 1
    at = after[np.isfinite(trace.readings["x_s"][after, 0])]
    trace.readings["x_s"][at[len(at) // 2]] = np.inf


WRONG: dict[Callable[[Trace], None], set[Failed]] = {
    leave_out_a_step: {Failed.PATH, Failed.CLOCK, Failed.EDGE, Failed.MOTION},
    forget_a_state: {Failed.PATH, Failed.MOTION, Failed.JUMP, Failed.READING},
    end_early: {Failed.PATH},
    change_a_state: {Failed.MOTION, Failed.JUMP, Failed.READING, Failed.INPUT},
    change_an_input: {Failed.MOTION, Failed.INPUT},
    leave_out_the_states: {Failed.READING},
    change_the_sensors_model: {Failed.READING},
    lose_the_sensors_model: {Failed.READING},
    change_the_controllers_model: {Failed.READING},
}


@pytest.mark.parametrize("change", WRONG, ids=lambda change: change.__name__)
def test_a_wrong_trace_is_refuted(traced: tuple[Trace, Table], change: Callable[[Trace], None]) -> None:
    trace = copy.deepcopy(traced[0])
    change(trace)
    found = compare(trace, DocumentNumbers(traced[1]))
    assert found.failure is not None
    assert found.failure.kind in WRONG[change], found.failure


@pytest.mark.parametrize("table", ["measured", "ticks"])
def test_a_recorded_model_that_is_no_number_is_refuted(table: str) -> None:
    recorded = RecordedLoop(simulate(resolved("double_integrator", "horizon_s=1")))
    document = document_of_scenario("double_integrator")
    assert compare(trace_of(recorded, document), document.numbers).conforms
    rows = getattr(recorded, table).copy()
    rows["x_s" if table == "measured" else "x_c"][len(rows) // 2] = np.nan
    setattr(recorded, table, rows)
    failure = compare(trace_of(recorded, document), document.numbers).failure
    assert failure is not None
    assert failure.kind is Failed.READING


OTHERS = {"dc_motor_load": 0.05, "lane_periodic": 0.05, "reactor_petc": 0.05, "servo_reference": 1.0}
"""Other kinds of documents, and a share of B that is refuted: a reference that moves disturbs the loop."""


@pytest.fixture(scope="module", params=OTHERS)
def other(request: pytest.FixtureRequest) -> tuple[Trace, RunDocument, Matrix]:
    """Return a run of another kind, its document, and B of its plant."""
    scenario = resolved(request.param, "horizon_s=4")
    statement = find_statement(scenario, "own", "schedule", most_work=0.0)
    document, loop = document_of_statement(statement, Naming(request.param)), statement.loop
    assert loop is not None
    record = simulate(scenario)
    trace = trace_of(RecordedLoop(record), document, reference_of_bounds(scenario))
    assert compare(trace, document.numbers).conforms
    return trace, document, floats(loop.B)


def refuted(trace: Trace, table: Table) -> bool:
    return not compare(trace, DocumentNumbers(table)).conforms


def test_another_plant_is_refuted(other: tuple[Trace, RunDocument, Matrix]) -> None:
    """B is larger."""
    trace, document, B = other
    share = OTHERS[document.table["name"]]
    table = copy.deepcopy(dict(document.table))
    moved = document.states.T - document.errors[0].T @ document.seen
    for corner in table["motions"]["driven"]:
        more = share * moved @ B @ numbers(corner["input"])
        corner["matrix"] = (numbers(corner["matrix"]) + more).tolist()
    assert refuted(trace, table)


def test_one_loss_fewer_is_refuted_where_so_many_occur(other: tuple[Trace, RunDocument, Matrix]) -> None:
    trace, document, _ = other
    lost = {name: place.number for name, place in document.places.items() if not place.waits}
    reached = max(lost[name] for name in trace.names if name in lost)
    table = copy.deepcopy(dict(document.table))
    table["edges"] = [edge for edge in table["edges"] if lost.get(edge["to"], -1) < reached or not reached]
    assert refuted(trace, table) == (reached > 0)


def test_each_edge_that_was_taken_is_needed(other: tuple[Trace, RunDocument, Matrix]) -> None:
    trace, document, _ = other
    taken = [name for name, count in compare(trace, document.numbers).edges.items() if count]
    assert len(taken) >= 3
    for name in taken:
        table = dict(document.table)
        table["edges"] = [edge for edge in table["edges"] if edge["name"] != name]
        assert refuted(trace, table), name


def test_a_smaller_threshold_is_refuted(other: tuple[Trace, RunDocument, Matrix]) -> None:
    trace, document, _ = other
    table = copy.deepcopy(dict(document.table))
    sizes = [name for name in ("share", "level", "floor") if name in table["rows"]]
    for name in sizes:
        table["rows"][name] = scaled(table["rows"][name], 0.8)
    assert refuted(trace, table) == bool(sizes)


RULES = {
    "held updates": "mode=zoh",
    "absolute": "trigger={policy='absolute',delta=0.05}",
    "relative": "trigger={policy='relative',sigma=0.05}",
    "mixed": "trigger={policy='mixed',sigma=0.05,epsilon=0.02}",
    "deadline": "trigger={policy='deadline',rule={policy='absolute',delta=0.05},interval_s=0.5}",
    "periodic": "trigger={policy='periodic',period_s=0.02}",
}


@pytest.mark.parametrize(
    "rule", [pytest.param(rule, marks=() if rule == "held updates" else pytest.mark.deep) for rule in RULES]
)
def test_runs_with_other_rules_conform(rule: str) -> None:
    """The document has what the input depends on of the error, and the least threshold of an event."""
    scenario = resolved("double_integrator", RULES[rule], "network.mansd=2", "horizon_s=4")
    found = conformance_with(simulate(scenario), find_statement(scenario, "own", "schedule"))
    assert found.conforms, found.failure


def test_a_run_whose_plant_steps_late_is_refuted_where_an_input_is_for_a_later_time() -> None:
    late = late_run(lambda step: 4 if step % 40 == 0 else 0)
    statement = find_statement(late.scenario, "own", "schedule", most_work=0.0)
    assert conformance_with(late_run(lambda _: 0), statement).conforms
    found = conformance_with(late, statement)
    assert found.failure is not None
    assert found.failure.kind in {Failed.INPUT, Failed.LIMIT}, found.failure


def test_a_run_as_late_as_the_document_allows_conforms() -> None:
    """Ages of inputs at both ends: steps are late by up to the lead, and by as much as is allowed."""
    record = late_run(lambda step: 3 if step % 40 == 0 else 0)
    widest = read_conditions(record).widen(allowed_conditions(record.scenario))
    (certificate,) = certificates_under(widest, record.scenario)
    assert certificate.document is not None
    assert conformance(record, certificate.document).conforms


@pytest.mark.parametrize(
    ("stored", "settings"),
    [
        pytest.param("filtered_mass", FILTERED_MASS, id="Kalman filter"),
        pytest.param(
            "claims", ("controller.setpoint=[0.3,0.0]", "plant.initial_state=[1.3,0.0]"), id="set-point"
        ),
    ],
)
def test_runs_with_an_estimate_or_a_set_point_conform(stored: str, settings: tuple[str, ...]) -> None:
    statement = proved(stored).statement._replace(loop=proved(stored).loop)
    record = simulate(resolved("double_integrator", *settings, "horizon_s=4"))
    found = conformance_with(record, statement)
    assert found.conforms, found.failure


WITHOUT_DOCUMENT = {
    "cart_pole", "cart_pole_mujoco", "dc_motor", "double_pendulum_mujoco", "four_tank", "lane_acknowledged",
    "lane_crosswind_load", "lane_python_trigger", "model_predictive", "quadrotor_hover", "saturated_lqr",
    "tabuada_dynamic",
}  # fmt: skip
"""Nothing is proved of them without a search, or no document describes the rule."""
LATER = {"lane_5g_rural": Failed.LIMIT}
"""Runs in which a packet takes longer than the schedule allows: an outage of the recorded network."""
QUICK = ("dc_motor_load", "lane_periodic", "reactor_petc", "selivanov_switching", "servo_reference")
"""A load, a periodic rule, tests at exact times, a dwell time, a reference that moves."""


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.deep)
        for name in shipped_names("scenarios")
    ],
)
def test_the_runs_of_a_shipped_scenario_conform(name: str) -> None:
    """With each of its documents: of its own plant, and of all within the uncertainty."""
    for loop in ResolvedRun(shipped(name)).loops[:4]:
        statements = [find_statement(loop, of, "schedule", most_work=0.0) for of in plants_of(loop)]
        found = [conformance_with(simulate(loop), each) for each in statements if has_document(each)]
        assert bool(found) != (name in WITHOUT_DOCUMENT)
        for each in found:
            assert (each.failure and each.failure.kind) == LATER.get(name), each.failure


def has_document(statement: WitnessedStatement) -> bool:
    return statement.loop is not None and statement.loop.rule.memory is None
