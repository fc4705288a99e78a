"""Runs are runs of their loop documents, and a document with a fault is refuted by one of them."""

import contextlib
import copy
import re
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from cosim.analysis.conformance.conformance import compare
from cosim.analysis.conformance.run_conformance import conformance_of, conformance_with
from cosim.analysis.conformance.trace import Trace, trace_of
from cosim.analysis.witnesses import find_statement
from cosim.shipped_files import shipped_names
from cosim.simulation.virtual_time import simulate
from noack.core.errors import CallerError
from noack.core.linear_systems import Matrix
from noack.proof.files import document_of
from noack.proof.loop_document import LoopDocument, Naming
from noack.scenario.resolution import ResolvedRun
from tests.checker.loops import FILTERED_MASS
from tests.checker.proofs import proved
from tests.cosim.simulation.late_plant import late_run
from tests.helpers.shipped import resolved, shipped

Table = dict[str, Any]
Change = Callable[[Table], None]
HORIZON_S = 6.0
LINEAR = ("double_integrator", "unstable_pendulum")


def document_of_scenario(name: str) -> LoopDocument:
    statement = find_statement(resolved(name), "own", "schedule", most_work=0.0)
    assert statement.document is not None
    assert statement.loop is not None
    return document_of(statement.loop, statement.document, Naming(name))


@pytest.fixture(scope="module", params=LINEAR)
def traced(request: pytest.FixtureRequest) -> tuple[Trace, Table]:
    """Return the trace of a simulated run with all losses that are allowed, and its document."""
    record = simulate(resolved(request.param, f"horizon_s={HORIZON_S}"))
    document = document_of_scenario(request.param)
    return trace_of(record, document), document.table


def test_a_run_is_a_run_of_its_document(traced: tuple[Trace, Table]) -> None:
    found = compare(*traced)
    assert found.conforms, found.verdict
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


REFUTED: dict[Change, str] = {
    push_harder: "no motion of the document leads to what was recorded",
    lose_fewer: "the document has no transition",
    lower_the_threshold: "does not hold",
    raise_the_threshold: "does not hold",
    arrive_sooner: "the clock is not within|lasts longer than",
    leave_out_an_edge: "the document has no transition",
    check_more_often: "lasts longer than|the clock is another one",
    keep_inputs_fresh: "no motion of the document|the input is none",
    forget_what_was_missed: "z is another one after it",
    start_elsewhere: "z at the start is another one",
}


@pytest.mark.parametrize("change", REFUTED, ids=lambda change: change.__name__)
def test_a_document_with_a_fault_is_refuted(traced: tuple[Trace, Table], change: Change) -> None:
    trace, document = traced[0], copy.deepcopy(traced[1])
    change(document)
    found = compare(trace, document)
    assert not found.conforms
    assert found.until_s < HORIZON_S
    assert re.search(REFUTED[change], found.reason), found.reason


def leave_out_a_step(trace: Trace) -> None:
    """One motion leads over two steps."""
    at = next(i for i, item in enumerate(trace.items) if i > 100 and item.is_motion)
    trace.items = trace.items[:at] + trace.items[at + 1 :]
    trace.steps = trace.steps[:at] + trace.steps[at + 1 :]
    trace.clocks_ns = trace.clocks_ns[:at] + trace.clocks_ns[at + 1 :]
    trace.z = np.delete(trace.z, at, axis=0)


def end_early(trace: Trace) -> None:
    trace.items, trace.steps = trace.items[:101], trace.steps[:102]
    trace.clocks_ns, trace.z = trace.clocks_ns[:102], trace.z[:102]


def change_a_state(trace: Trace) -> None:
    trace.z[500, 0] *= 1.0001


def change_an_input(trace: Trace) -> None:
    trace.u[200] *= 1.01


WRONG: dict[Callable[[Trace], None], str] = {
    leave_out_a_step: "step by step|after",
    end_early: "all steps of the record",
    change_a_state: "no motion of the document|z is another one|x is not the recorded one",
    change_an_input: "no motion of the document|the input is none",
}


@pytest.mark.parametrize("change", WRONG, ids=lambda change: change.__name__)
def test_a_wrong_trace_is_refuted(traced: tuple[Trace, Table], change: Callable[[Trace], None]) -> None:
    trace = copy.deepcopy(traced[0])
    trace.u, trace.x = trace.u.copy(), trace.x.copy()
    change(trace)
    found = compare(trace, traced[1])
    assert not found.conforms
    assert re.search(WRONG[change], found.reason), found.reason


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
    assert found.conforms, found.verdict


def test_a_run_whose_plant_steps_late_is_refuted_where_an_input_is_for_a_later_time() -> None:
    record = late_run(lambda step: 4 if step % 40 == 0 else 0)
    with pytest.raises(CallerError, match="there is no"):
        conformance_of(record)  # of this case no proof is known
    statement = find_statement(record.scenario, "own", "schedule")
    assert conformance_with(late_run(lambda _: 0), statement).conforms
    found = conformance_with(record, statement)
    assert not found.conforms
    assert re.search("input is none that the document allows|lasts longer than", found.reason), found.reason


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
    assert found.conforms, found.verdict


@pytest.mark.deep
@pytest.mark.parametrize("name", shipped_names("scenarios"))
def test_the_runs_of_a_shipped_scenario_conform(name: str) -> None:
    """Those that have a document which can be compared yet."""
    for loop in ResolvedRun(shipped(name)).loops[:4]:
        with contextlib.suppress(CallerError):  # there is no document, or it cannot be compared yet
            found = conformance_of(simulate(loop))
            assert found.conforms, found.verdict
