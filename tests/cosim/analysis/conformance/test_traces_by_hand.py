"""Traces of small documents that are written by hand: which are runs of the document, and which are not.

The document has a state x with ẋ = u + p, and corners in which u = −k x and the unknown p is at most 0.1 |u|.
"""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.conformance.conformance import compare
from cosim.analysis.conformance.document_numbers import DocumentNumbers
from cosim.analysis.conformance.trace import Trace
from cosim.analysis.conformance.verdicts import Failed

Table = dict[str, Any]
STEP_S = 0.01


def document(*gains: float, share: float = 0.1, along: float | None = None, least: float = 0.0) -> Table:
    """Return the document; with ``along`` p · (along x) ≥ least p²."""
    more = {} if along is None else {"along": [[along]], "least": least}
    return {
        "name": "by hand",
        "coordinates": [{"name": "x", "unit": ""}],
        "rows": {},
        "facts": {},
        "motions": {
            "driven": [
                {
                    "matrix": [[-gain]],
                    "input": [[-gain]],
                    "unknown": [{"column": [[1]], "rows": [[share * gain]], **more}],
                }
                for gain in gains
            ]
        },
        "locations": [{"name": "on", "coordinates": ["x"], "motion": "driven", "facts": [], "clock": 1}],
        "edges": [],
        "start": {"location": "on", "columns": [[1]], "facts": []},
        "outputs": [],
        "readings": {"x": [{"rows": [[1]], "in": ["on"]}]},
    }


def trace(gain: float, push: float, steps: int = 20) -> Trace:
    """Return the trace in which u = −gain x at the beginning of each step, and p = push |u|."""
    x, u = [1.0], []
    for _ in range(steps):
        u.append(-gain * x[-1])
        x.append(x[-1] + STEP_S * (u[-1] + push * abs(u[-1])))
    t_ns = np.arange(steps + 1, dtype=np.int64) * round(STEP_S * 1e9)
    states = np.array(x)[:, None]
    return Trace(
        names=["on"],
        items=np.zeros(steps, np.int32),
        is_motion=np.ones(steps, bool),
        steps=np.arange(steps + 1, dtype=np.int32),
        clocks_ns=t_ns.copy(),
        is_sampled=np.ones(steps, bool),
        rows=np.arange(steps + 1, dtype=np.int32),
        z=states,
        t_ns=t_ns,
        is_recorded=np.ones(steps + 1, bool),
        u=np.array([*u, u[-1]])[:, None],
        readings={"x": states.copy()} | {name: np.full((steps + 1, 1), np.nan) for name in ("x_s", "x_c")},
    )


def failed(found: Trace, table: Table) -> Failed | None:
    failure = compare(found, DocumentNumbers(table)).failure
    return None if failure is None else failure.kind


@pytest.mark.parametrize("gains", [(1.0, 2.0), (2.0, 1.0)])
@pytest.mark.parametrize("gain", [1.05, 1.5, 1.95])
def test_a_signal_is_limited_by_the_mixture_of_corners_that_the_input_is(
    gain: float, gains: tuple[float, float]
) -> None:
    """|p| ≤ 0.1 |u| whichever corner comes first; a step changes x by 2 %, which counts as rounding."""
    table = document(*gains)
    assert failed(trace(gain, 0.099), table) is None
    assert failed(trace(gain, -0.099), table) is None
    assert failed(trace(gain, 0.11), table) is Failed.MOTION
    assert failed(trace(gain, -0.11), table) is Failed.MOTION


@pytest.mark.parametrize("least", [0.0, 1.0, 100.0])
def test_a_signal_has_the_sign_that_the_document_requires(least: float) -> None:
    """p · x ≥ least p², and x > 0: so p is not below 0, and at most x/least."""
    table = document(1, 1.2, along=1.0, least=least)
    assert failed(trace(1.1, 0.008), table) is None
    assert failed(trace(1.1, -0.008), table) is Failed.MOTION
    assert failed(trace(1.1, 0.09), table) is (Failed.MOTION if least == 100 else None)


def test_corners_with_other_signals_are_not_compared() -> None:
    table = document(1, 2)
    table["motions"]["driven"][1]["unknown"][0]["column"] = [[2]]
    assert failed(trace(1.5, 0.0), table) is Failed.MOTION


def begin_the_clock_earlier(found: Trace) -> None:
    found.clocks_ns -= found.t_ns[1]


def let_no_time_pass(found: Trace) -> None:
    """The third step lasts no time, and moves nothing."""
    found.t_ns[3:] -= found.t_ns[1]
    found.clocks_ns[3:] -= found.clocks_ns[1]
    found.z[3:] = found.z[2:-1].copy()
    found.readings["x"][3:] = found.readings["x"][2:-1].copy()
    found.u[3:] = found.u[2:-1].copy()


def lose_an_input(found: Trace) -> None:
    found.u[4] = np.nan


def lose_a_state(found: Trace) -> None:
    found.z[4] = np.nan


def start_nowhere(found: Trace) -> None:
    found.z[0] = np.nan


WRONG = {
    begin_the_clock_earlier: {Failed.CLOCK},
    let_no_time_pass: {Failed.PATH},
    lose_an_input: {Failed.MOTION, Failed.INPUT},
    lose_a_state: {Failed.MOTION, Failed.INPUT, Failed.READING},
    start_nowhere: {Failed.JUMP},
}


@pytest.mark.parametrize("change", WRONG, ids=lambda change: change.__name__)
def test_a_wrong_trace_is_refuted(change: Any) -> None:
    found = trace(1.5, 0.05)
    assert failed(found, document(1, 2)) is None
    change(found)
    assert failed(found, document(1, 2)) in WRONG[change]


def test_x_is_read_in_each_location_that_was_visited() -> None:
    table = document(1, 2)
    table["locations"].append({**table["locations"][0], "name": "off"})
    assert failed(trace(1.5, 0.05), table) is None
    table["readings"]["x"][0]["in"] = ["off"]
    assert failed(trace(1.5, 0.05), table) is Failed.READING
