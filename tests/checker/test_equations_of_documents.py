"""That a document allows all that a plant's equations do: what is verified, and false claims."""

import copy
import functools
import json
import re
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb

from cosim.analysis.loop_files import loop_files
from cosim.analysis.witnesses import WitnessedStatement, find_witnesses
from noack.plants.systems.equation_text import equation_lines
from noack.plants.systems.traced_equations import trace
from noack.proof.equations_claim import equations_text
from noack.proof.gains_document import gains_files
from noack.proof.loop_document import Naming
from noack_equations import Region, RejectedError, claimed_digest, enclose, prove_equations
from noack_equations.text import block_of, digest_of, steps_of
from noack_gains import prove as prove_by_gains
from noack_kernel import prove
from tests.checker.traced_plants import Plant
from tests.helpers.shipped import resolved

Table = dict[str, Any]
NAMES = ("sine_pendulum", "friction_servo", "kinematic_car")


@functools.cache
def files(name: str, conditions: str = "schedule") -> tuple[str, str, str]:
    """Return the contents of a document, its proof, and the file of the equations."""
    found = find_witnesses(scenario := resolved(name), most_work=0.0, conditions=(conditions,))
    (statement,) = found.statements
    assert isinstance(statement, WitnessedStatement)
    assert statement.document is not None, statement.reason
    of = loop_files(scenario, statement)
    return of.document, of.proof, equations_text(statement.document)


def pendulum() -> tuple[Table, str]:
    document, _, equations = files("sine_pendulum", "ideal")
    return json.loads(document), equations


@pytest.mark.parametrize("conditions", ["ideal", "schedule"])
@pytest.mark.parametrize("name", NAMES)
def test_documents_of_shipped_plants_allow_what_their_equations_do(name: str, conditions: str) -> None:
    document, proof, equations = files(name, conditions)
    assert prove(document, proof)
    proven = prove_equations(document, equations)
    assert proven.digest == digest_of(equations) == claimed_digest(document)
    assert proven.further == 0
    assert str(proven).startswith("the document allows all that the equations with the SHA-256")
    assert len(proven.limits) == len(json.loads(document).get("while", []))


def entry(M: list[Any], i: int, j: int, change: Callable[[Fraction, Fraction], Any]) -> None:
    """Change an entry of a matrix, a number or an interval."""
    value = M[i][j]
    ends = [Fraction(str(v)) for v in (value if isinstance(value, list) else [value, value])]
    M[i][j] = change(*ends)


def corners(document: Table) -> list[Table]:
    return [corner for motion in document["motions"].values() for corner in motion]


def narrower(document: Table, equations: str) -> str:
    claim = document["equations"]
    (place,) = ((i, k) for i, row in enumerate(claim["half_A"]) for k, h in enumerate(row) if h)
    claim["half_A"][place[0]][place[1]] *= 0.99
    return equations


def in_all_corners(change: Callable[[Table], object]) -> Callable[[Table, str], str]:
    def changed(document: Table, equations: str) -> str:
        for corner in corners(document):
            change(corner)
        return equations

    return changed


def with_digest(document: Table, equations: str) -> str:
    document["equations"]["sha256"] = digest_of(equations)
    return equations


def of_claim(key: str, value: Any) -> Callable[[Table, str], str]:
    def changed(document: Table, equations: str) -> str:
        document["equations"][key] = value
        return equations

    return changed


def wider_limit(document: Table, equations: str) -> str:
    document["while"][0]["less"] *= 1.01
    return equations


def unlimited(document: Table, equations: str) -> str:
    del document["while"]
    return equations


FALSE: dict[str, tuple[Callable[[Table, str], str], str]] = {
    "an enclosure 1 % too narrow": (narrower, r"slope A\[1, 0\]"),
    "a limit 1 % larger": (wider_limit, r"slope A\[1, 0\]"),
    "no limit": (unlimited, r"slope A\[1, 0\]"),
    "another sign": (
        lambda d, e: with_digest(d, e.replace("s_9 = x_2 · 0.1", "s_9 = x_2 · -0.1")), r"slope A\[1, 1\]",
    ),
    "more gravity": (lambda d, e: with_digest(d, e.replace("9.81", "9.85")), r"slope A\[1, 0\]"),
    "a torque of another size": (
        lambda d, e: with_digest(d, e.replace("s_11 + u_1", "s_11 + s_13").replace(
            "s_12 =", "s_13 = u_1 · 1.01\ns_12 =")), r"slope B\[1, 0\]",
    ),
    "a constant more": (
        lambda d, e: with_digest(d, e.replace("dx_1/dt = x_2", "s_20 = x_2 + 0.001\ndx_1/dt = s_20")),
        "signals: the equations have 1, the document has 0",
    ),
    "another hash": (of_claim("sha256", "0" * 64), "and the file has others"),
    "no hash": (of_claim("sha256", "0"), "not 64 hexadecimal digits"),
    "other equations of the same file": (lambda d, e: e.replace("9.81", "9.8"), "and the file has others"),
    "a state less": (of_claim("states", ["angle"]), "not a matrix|a row has not"),
    "states exchanged": (of_claim("states", ["rate", "angle"]), r"slope A\[1, 0\]"),
    "errors exchanged": (of_claim("errors", ["e rate", "e angle"]), "is too narrow"),
    "no errors": (
        lambda d, e: of_claim("errors", [])(d, e) and of_claim("of", [])(d, e), "it moves other coordinates",
    ),
    "errors twice as large": (of_claim("of", [[2, 0], [0, 2]]), "is too narrow"),
    "a unit for a state": (of_claim("states", ["angle", "f1"]), "a unit or noise is none"),
    "an unknown key": (of_claim("more", 1), "unknown key 'more'"),
    "a negative half-width": (of_claim("half_B", [[0], [-1]]), "not below 0"),
    "a plant that the motions do not have": (
        lambda d, e: entry(d["equations"]["A"], 0, 1, lambda low, high: [0.99, 1.01]) or e,
        "the row of 'angle' does not contain the interval",
    ),
    "a motion with another row": (
        in_all_corners(lambda c: entry(c["matrix"], 1, 1, lambda low, high: float(low) * 1.01)),
        "the row of 'rate' does not contain the interval",
    ),
    "a motion without its signal": (
        in_all_corners(lambda c: c["unknown"].clear()), "fewer unknown signals than the equations have",
    ),
    "a signal with a smaller row": (
        in_all_corners(lambda c: entry(c["unknown"][0]["rows"], 0, 0, lambda low, high: 0.99 * float(low))),
        r"the entry A\[1, 0\] does not contain the interval",
    ),
    "a signal that does not move the error": (
        in_all_corners(lambda c: c["unknown"][0]["column"].__setitem__(3, [0])),
        r"the entry A\[1, 0\] does not contain the interval",
    ),
    "an edge that changes a state": (
        lambda d, e: d["edges"][0]["jump"][0].__setitem__(0, 0.99) or e, "it changes the state 'angle'",
    ),
    "an edge that takes time": (lambda d, e: d["edges"][0].update(duration=0.01) or e, "duration|takes time"),
    "a signal that takes energy": (
        in_all_corners(lambda c: c["unknown"][0].update(along=[[0] * len(c["matrix"])], least=0)),
        "it is not known to take so much",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FALSE)
def test_a_false_claim_is_rejected(name: str) -> None:
    document, equations = copy.deepcopy(pendulum())
    prove_equations(json.dumps(document), equations)
    change, reason = FALSE[name]
    equations = change(document, equations)
    with pytest.raises(RejectedError, match=reason):
        prove_equations(json.dumps(document), equations)


FALSE_FRICTION: dict[str, tuple[Callable[[Table], object], str]] = {
    "friction of another size": (
        lambda d: d["equations"]["signals"][0].update(column=[[0], [-0.99]]), "larger",
    ),
    "friction that takes more": (lambda d: d["equations"]["signals"][0].update(least=1.01), "so much"),
    "friction along the angle": (
        lambda d: d["equations"]["signals"][0].update(along=[[500, 0, 0]]), "along with something else",
    ),
    "friction along the input": (
        lambda d: d["equations"]["signals"][0].update(along=[[0, [499, 501], [-1, 1]]]),
        "which is a mixture|a mixture of inputs",
    ),
    "no friction": (lambda d: d["equations"]["signals"].clear(), "signals: the equations have"),
    "a motion whose friction takes more": (
        lambda d: [c["unknown"][0].update(least=2) for c in corners(d)], "so much",
    ),
    "a motion with less friction": (
        lambda d: [entry(c["unknown"][0]["column"], 1, 0, lambda low, high: -0.99) for c in corners(d)],
        "the signal 0 does not contain the interval",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FALSE_FRICTION)
def test_false_friction_is_rejected(name: str) -> None:
    document, _, equations = files("friction_servo")
    table = json.loads(document)
    change, reason = FALSE_FRICTION[name]
    change(table)
    with pytest.raises(RejectedError, match=reason):
        prove_equations(json.dumps(table), equations)


def test_further_signals_are_no_fault() -> None:
    document, equations = copy.deepcopy(pendulum())
    for corner in corners(document):
        corner["unknown"].append(
            {"column": [[0]] * len(corner["matrix"]), "rows": corner["unknown"][0]["rows"]}
        )
    assert prove_equations(json.dumps(document), equations).further == 1


def test_a_file_may_have_several_equations() -> None:
    document, _, equations = files("sine_pendulum", "ideal")
    other = equations.replace("9.81", "9.8")
    assert prove_equations(document, f"{other}\n{equations}")
    with pytest.raises(RejectedError, match="the file has others"):
        prove_equations(document, other)


def test_a_document_of_a_linear_plant_claims_nothing() -> None:
    document, equations = pendulum()
    del document["equations"]
    assert claimed_digest(json.dumps(document)) is None
    with pytest.raises(RejectedError, match="claims nothing"):
        prove_equations(json.dumps(document), equations)


# Bounds by gains.


def test_a_document_for_bounds_by_gains_allows_what_equations_do() -> None:
    (statement,) = find_witnesses(resolved("dc_motor"), most_work=0.0, conditions=("ideal",)).statements
    assert statement.document is not None
    assert statement.loop is not None
    of, equations = (
        gains_files(statement.loop, statement.document, Naming("motor")),
        equations_text(statement.document),
    )
    assert prove_by_gains(of.document, of.proof).bounds
    assert prove_equations(of.document, equations).digest == claimed_digest(of.document)
    table = json.loads(of.document)
    for change in (
        lambda d: entry(d["A"], 0, 0, lambda low, high: 1.01 * float(low) + 0.01),
        lambda d: d["disturbances"].clear(),
        lambda d: d["equations"].update(sha256="0" * 64),
    ):
        changed = copy.deepcopy(table)
        change(changed)
        with pytest.raises(RejectedError):
            prove_equations(json.dumps(changed), equations)


# The text of equations.


def test_equations_are_read_line_by_line() -> None:
    assert files("sine_pendulum", "ideal")[2].splitlines() == [
        "s_5 = sin(x_1)", "s_7 = s_5 · 9.81", "s_9 = x_2 · 0.1", "s_10 = −s_9", "s_11 = s_7 + s_10",
        "s_12 = s_11 + u_1", "dx_1/dt = x_2", "dx_2/dt = s_12",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "field",
    [
        lambda x, u: [x[1], u[0] * abs(x[0]) - 0.3 * x[1] ** 3 / (2.0 + x[0])],
        lambda x, u: [x[1].clip(None, 0.5) - 1e-7 * x[0], -(u[0] - x[0]).clip(-0.5, 0.8)],
        lambda x, u: [(x[0] + 3.0).sqrt(), -x[1] if x[0] < 2.0 else x[1] + u[0]],
        lambda x, u: [x[0].sin() * x[1].tanh(), x[1].sign() + u[0]],
    ],
)  # fmt: skip
def test_a_text_is_read_as_the_steps_that_it_was_written_from(field: Any) -> None:
    document = trace(Plant(field), 2, 1, np.array([0.8, 0.6, 1.5])).document  # type: ignore[arg-type]
    text = "".join(f"{line}\n" for line in equation_lines(document))
    assert len(equation_lines(steps_of(text))) == len(text.splitlines())
    region = Region((arb(0.8), arb(0.6)), (arb(1.5),))
    first, second = enclose(document, region), enclose(steps_of(text), region)
    for M, N in zip(first[:5], second[:5], strict=True):
        assert [entry.mid() for entry in M.entries()] == [entry.mid() for entry in N.entries()]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("dx_1/dt = x_2", "no such state"),
        ("dx_2/dt = x_1", "the rates are not dx_1/dt"),
        ("dx_1/dt = x_1\ndx_1/dt = x_1", "dx_1/dt occurs twice"),
        ("s_1 = x_1\ns_1 = x_1\ndx_1/dt = s_1", "s_1 occurs twice"),
        ("dx_1/dt = s_1", "'s_1' is no number, and no step before it"),
        ("dx_1/dt = gamma(x_1)", "'gamma' is no function"),
        ("dx_1/dt = clip(x_1, 1)", "'clip' is no function of such a form"),
        ("dx_1/dt = nan", "'nan' is no number"),
        ("dx_1/dt = 1e999", "no number"),
        ("dx_1/dt = x_1 + x_1 + x_1", "no number, and no step"),
        ("import os", "neither a step, a rate nor a case"),
        ("", "not from 1 to"),
        ("dx_1/dt = positive(x_1)", "is no function"),
    ],
)
def test_a_text_without_a_meaning_is_rejected(text: str, reason: str) -> None:
    with pytest.raises(RejectedError, match=re.escape(reason)):
        enclose(steps_of(text), Region((None,), (None,)))


def test_spaces_at_ends_of_lines_are_no_difference() -> None:
    text = "s_1 = sin(x_1)\ndx_1/dt = s_1\n"
    assert block_of(f"\n{text.replace(chr(10), ' ' + chr(13) + chr(10))}\n\n", digest_of(text))
