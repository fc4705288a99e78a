"""The kernel proves of loop documents what the checker proves, and rejects faults of documents and proofs."""

import copy
import json
import re
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest
from flint import arb, fmpq

from noack.proof.elaborate.tables import read_number
from noack.proof.forms_proof import as_text, write_proof
from noack.proof.loop_document import LoopDocument, Naming
from noack.proof.search.results import read_assumptions
from noack.proof.words import in_words
from noack_kernel import RejectedError, Statement, prove
from noack_kernel.__main__ import UNREADABLE, verify
from noack_kernel.statement import root_above
from tests.checker.proofs import SEARCHES, Proved, proved

Table = dict[str, Any]
Change = Callable[[Table, Table], None]
A_LOOP = Naming("a loop")
OF_EACH_KIND = {
    "claims_box",
    "tests_dynamic",
    "changed_later",
    "changed_noisy",
    "filtered_mass",
    "friction_servo",
    "holding",
    "in_the_limit",
    "observed",
    "pendulum_ideal",
    "periodic_short",
    "rate_0",
    "relative_tested",
    "tests_dwell_a_loss",
    "until_due",
}
"""Stored proofs that together have every kind of coordinate, fact, motion, location, edge and output."""


def files_of(stored: Proved, naming: Naming = A_LOOP) -> tuple[Table, Table]:
    """Return the loop document and the proof of a stored statement."""
    content, loop = stored.document, stored.loop
    rate, bounds = read_number(content, "rate"), content["bounds"]
    outputs = [bound["output"] for bound in bounds]
    document = LoopDocument(loop, rate, read_assumptions(loop, rate, content), outputs, naming)
    return copy.deepcopy((document.table, write_proof(document, bounds)))


def proven(document: Table, proof: Table) -> list[Statement]:
    """Return what a proof proves, whatever document it names."""
    return prove(as_text(document), as_text({k: v for k, v in proof.items() if k != "document"})).bounds


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=() if name in OF_EACH_KIND else pytest.mark.deep) for name in sorted(SEARCHES)],
)
def test_the_kernel_proves_what_the_checker_proves(name: str) -> None:
    stored = proved(name)
    document, proof = files_of(stored)
    statements = prove(as_text(document), as_text(proof)).bounds
    entries = stored.document["bounds"]
    further = statements[len(entries) :]
    assert {statement.output for statement in further} <= {"error of the sensor's model"}
    statements = statements[: len(entries)]
    for statement, entry in zip(statements, entries, strict=True):
        levels = [entry["numbers"].get(f"level {k}", 0.0) for k in (1, 2)]
        assert [float(arb(level).mid()) for level in statement.levels] == pytest.approx(levels, rel=1e-15)
        assert statement.from_start == entry.get("from_start", True)
    assert in_words(document).startswith("# Loop document: a loop\n")


@pytest.mark.parametrize("state", ["f1", "f2", "e rate", "w rate", "f1 (2)"])
def test_names_that_a_document_uses_itself_do_not_spoil_it(state: str) -> None:
    """Names of coordinates differ; the norm of all states has no unit, whatever an output is called."""
    naming = Naming("a loop", [state, "rate"], ["all states"], ["rad", "rad/s"], ["deg"])
    document, proof = files_of(proved("pendulum"), naming)
    texts = [str(statement) for statement in proven(document, proof)]
    assert texts[0] == "|all states| ≤ 0.398237 e^(−0.3 t) + 0.0121655 at all times"
    assert texts[1].startswith("|all states (2)| ≤ ")
    assert texts[1].endswith(" deg at all times")
    units = {coordinate["name"]: coordinate["unit"] for coordinate in document["coordinates"]}
    assert units[f"e {state}"] == "rad"
    assert sorted(units.values()) == sorted(["rad", "rad/s"] * 3 + ["", ""])


# Documents and proofs with one fault.


def pendulum() -> tuple[Table, Table]:
    """Return a document with losses, a delay and tests, and a proof of one bound."""
    document, proof = files_of(proved("pendulum"))
    first, *_, drift = proof["bounds"]
    assert drift["output"] == "mismatch of the sensor's model"
    return document, proof | {"bounds": [first, drift]}


def index(document: Table, name: str) -> int:
    """Return the index of a coordinate."""
    return [coordinate["name"] for coordinate in document["coordinates"]].index(name)


def entry(document: Table, key: str, name: str) -> Table:
    """Return the location, edge or output of a name."""
    found: Table = next(each for each in document[key] if each["name"] == name)
    return found


def scaled(rows: list[list[Any]], factor: float) -> list[list[Any]]:
    """Return rows times a factor."""
    return [[v if isinstance(v, list) else v * factor for v in row] for row in rows]


def shrink_levels(document: Table, proof: Table) -> None:
    """Levels 1 % lower."""
    proof["bounds"][0]["levels"] = [0.99 * level for level in proof["bounds"][0]["levels"]]


def grow_start(document: Table, proof: Table) -> None:
    row = index(document, "x0")
    document["start"]["columns"][row] = [1.01 * v for v in document["start"]["columns"][row]]


def grow_threshold(document: Table, proof: Table) -> None:
    document["rows"]["level"] = scaled(document["rows"]["level"], 1.02)


def push_harder(document: Table, proof: Table) -> None:
    for corner in document["motions"]["driven"]:
        low, high = corner["matrix"][1][0]
        corner["matrix"][1][0] = [low + 3, high + 3]


def widen_an_interval(document: Table, proof: Table) -> None:
    corner = document["motions"]["driven"][0]
    low, high = corner["matrix"][1][0]
    corner["matrix"][1][0] = [low, high + 3]


def empty_an_interval(document: Table, proof: Table) -> None:
    document["motions"]["driven"][0]["matrix"][1][0].reverse()


def negate_a_multiplier(document: Table, proof: Table) -> None:
    multipliers = proof["bounds"][0]["multipliers"]
    key = next(key for key in multipliers if key.startswith("edge/0 lost, sent"))
    fact = next(iter(multipliers[key]["facts"]))
    multipliers[key]["facts"][fact] = -1e-9


def use_a_fact_elsewhere(document: Table, proof: Table) -> None:
    proof["bounds"][0]["multipliers"]["motion/0 lost/0"] = {"facts": {"silent": 1}}


def use_an_inequality_that_is_none(document: Table, proof: Table) -> None:
    proof["bounds"][0]["multipliers"]["motion/4 lost/0"] = {}


def leave_out_a_coordinate(document: Table, proof: Table) -> None:
    location = entry(document, "locations", "1 lost")
    location["coordinates"] = [name for name in location["coordinates"] if not name.startswith("w ")]


def stop_a_loss(document: Table, proof: Table) -> None:
    """An update that is lost leads to a place in which w is 0."""
    entry(document, "edges", "0 lost, lost")["to"] = "0 lost"


def lose_more(document: Table, proof: Table) -> None:
    """Losses go on from the last place."""
    edge = copy.deepcopy(entry(document, "edges", "2 lost, lost"))
    document["edges"].append(edge | {"name": "3 lost, lost", "from": "3 lost", "to": "3 lost"})


def wait_longer(document: Table, proof: Table) -> None:
    """Its proof has nodes up to the old time."""
    entry(document, "locations", "0 later")["clock"] = 0.0061


def wait_longer_with_nodes(document: Table, proof: Table) -> None:
    """The forms of the old times are stretched."""
    entry(document, "locations", "0 later")["clock"] = 0.1
    for bound in proof["bounds"]:
        bound["forms"]["0 later"]["nodes"] = [0, 0.1]


def begin_later(document: Table, proof: Table) -> None:
    proof["bounds"][0]["forms"]["0 lost"]["nodes"][0] = 0.0001


def swap_nodes(document: Table, proof: Table) -> None:
    proof["bounds"][0]["forms"]["0 lost"]["nodes"].reverse()


def hold_a_unit(document: Table, proof: Table) -> None:
    row = index(document, "f1")
    for corner in document["motions"]["driven"]:
        corner["matrix"][row][row] = 0


def jump_a_unit(document: Table, proof: Table) -> None:
    row = index(document, "f1")
    document["edges"][0]["jump"][row][row] = 2


def start_a_unit(document: Table, proof: Table) -> None:
    document["start"]["columns"][index(document, "f1")] = [0]


def leave_out_a_unit(document: Table, proof: Table) -> None:
    del document["constant"]


def decay_faster(document: Table, proof: Table) -> None:
    proof["bounds"][0]["decay"] *= 1.5


def claim_a_limit(document: Table, proof: Table) -> None:
    """A decay that is not above twice the rate."""
    proof["bounds"][0] |= {"from": "limit", "decay": 0.6}


def have_no_row(document: Table, proof: Table) -> None:
    """An output of nothing is 0, whatever its name says."""
    document["outputs"][0]["rows"] = []


def be_nowhere(document: Table, proof: Table) -> None:
    entry(document, "outputs", "all states")["in"] = []


def be_in_an_unknown_place(document: Table, proof: Table) -> None:
    entry(document, "outputs", "all states")["in"] = ["5 lost"]


def have_no_corner(document: Table, proof: Table) -> None:
    document["motions"]["driven"] = []


def name_an_edge_twice(document: Table, proof: Table) -> None:
    document["edges"][1]["name"] = document["edges"][0]["name"]


def lead_nowhere(document: Table, proof: Table) -> None:
    document["edges"].append(
        {"name": "4 lost", "from": "3 lost", "to": None, "clock": "zero", "facts": ["event, level"]}
    )


def act_outside_of_the_clock(document: Table, proof: Table) -> None:
    document["edges"][0]["when"] = [0, 1]


def keep_a_clock_with_other_nodes(document: Table, proof: Table) -> None:
    entry(document, "edges", "0 later, all lost")["clock"] = "keeps"


def assume_something(document: Table, proof: Table) -> None:
    document["assumes"] = {"errors": 1}


def write_nan(document: Table, proof: Table) -> None:
    document["rows"]["level"][0][0] = "NaN"


def have_no_bound(document: Table, proof: Table) -> None:
    proof["bounds"] = []


def weaken_a_matrix(document: Table, proof: Table) -> None:
    matrices = proof["bounds"][0]["matrices"]
    matrices["X"][0][0] *= 0.9


def skew_a_matrix(document: Table, proof: Table) -> None:
    proof["bounds"][0]["matrices"]["X"][0][1] *= 1.0001


def limit_the_angle(document: Table, proof: Table) -> None:
    """The bound of ‖x‖ is 0.3984, above the limit."""
    document["while"] = [{"output": "all states", "less": 0.39}]


FAULTS: dict[Change, str] = {
    shrink_levels: "not proven at output/",
    grow_start: "not proven at start",
    grow_threshold: "not proven at",
    push_harder: "not proven at motion/",
    widen_an_interval: "not proven at motion/",
    empty_an_interval: "two ends in their order",
    negate_a_multiplier: "multiplier below 0",
    use_a_fact_elsewhere: "does not hold here",
    use_an_inequality_that_is_none: "no inequality",
    leave_out_a_coordinate: "lacks",
    stop_a_loss: "lacks",
    lose_more: "not proven at edge/3 lost, lost",
    wait_longer: "end before the clock",
    wait_longer_with_nodes: "not proven at motion/0 later",
    begin_later: "begin at 0",
    swap_nodes: "begin at 0",
    hold_a_unit: "does not move as a unit",
    jump_a_unit: "a unit changes",
    start_a_unit: "a unit is not 1",
    leave_out_a_unit: "lacks is not 0",
    decay_faster: "not proven at motion/",
    claim_a_limit: "above twice the rate",
    have_no_row: "it has no row",
    be_nowhere: "in no location",
    be_in_an_unknown_place: "unknown name",
    have_no_corner: "no corner",
    name_an_edge_twice: "occurs twice",
    lead_nowhere: "leads nowhere",
    act_outside_of_the_clock: "within the clock",
    keep_a_clock_with_other_nodes: "nodes differ",
    assume_something: "unknown key",
    write_nan: "not a number",
    have_no_bound: "no bound",
    weaken_a_matrix: "not proven at",
    skew_a_matrix: "not symmetric",
    limit_the_angle: "no proven bound is below 0.39",
}


def test_without_a_fault_it_is_proven() -> None:
    assert len(proven(*pendulum())) == 2


@pytest.mark.parametrize("change", FAULTS, ids=lambda change: change.__name__)
def test_a_fault_is_rejected(change: Change) -> None:
    document, proof = pendulum()
    change(document, proof)
    with pytest.raises(RejectedError, match=FAULTS[change]):
        proven(document, proof)


def test_a_limit_that_the_bound_is_below_holds() -> None:
    document, proof = pendulum()
    document["while"] = [{"output": "all states", "less": 0.4}]
    assert proven(document, proof)[0].largest < 0.4


def test_a_proof_of_another_document_is_rejected() -> None:
    document, proof = pendulum()
    with pytest.raises(RejectedError, match="another document"):
        prove(as_text(document | {"name": "b"}), as_text(proof))


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[]", 'the document is not a file of the format "noack-hybrid 1"; the order'),
        ("{", "the document is not JSON"),
        ('{"format": "noack-hybrid 2"}', "of the format \"noack-hybrid 1\", but one of 'noack-hybrid 2'"),
        ('{"format": "noack-hybrid 1", "format": "noack-hybrid 1"}', "the key 'format' occurs twice"),
        ('{"format": "noack-hybrid 1", "name": 1e99999999}', "not a number, or too long"),
        ('{"format": "noack-hybrid 1", "name": NaN}', "not a number"),
        ('{"format": "noack-hybrid 1", "name": ' + "[" * 100_000 + "}", "nested too deeply"),
        ('{"format": "noack-hybrid 1", "name": ' + "1" * 5000 + "}", "not a number, or too long"),
    ],
)
def test_a_malformed_text_is_rejected_in_one_line(text: str, fault: str) -> None:
    with pytest.raises(RejectedError, match=fault) as caught:
        prove(text, text)
    assert "\n" not in str(caught.value)


# Noise, in documents of one state. Each of these bounds is false: the kernel must not prove it.


def noisy(matrix: list[list[float]], rows: list[list[float]], jump: list[list[float]] | None = None) -> Table:
    """Return a document with a state x, noise n that no fact bounds, and f2."""
    still = [[0, 0, 0]] * 2
    return {
        "format": "noack-hybrid 1",
        "name": "noise",
        "coordinates": [
            {"name": "x", "unit": ""}, {"name": "n", "unit": "", "noise": True}, {"name": "f2", "unit": ""}
        ],
        "constant": "f2",
        "rows": {"n": [[0, 1, 0]], "f2": [[0, 0, 1]], "x and n": [[1, 1, 0]]},
        "facts": {},
        "motions": {"m": [{"matrix": [*matrix, *still], "input": [], "unknown": []}]},
        "locations": [{"name": "a", "coordinates": ["x"], "clock": 1, "motion": "m", "facts": []}],
        "edges": [
            {
                "name": "e", "from": "a", "to": "a", "when": [0, 1], "clock": "zero", "facts": [],
                "jump": [*(jump or [[1, 0, 0]]), [0, 0, 0], [0, 0, 1]],
            }
        ],
        "start": {"location": "a", "columns": [[0, 0], [0, 1], [1, 0]], "facts": []},
        "outputs": [{"name": "y", "unit": "", "rows": rows, "in": ["a"]}],
    }  # fmt: skip


def bound_of_x(terms: list[Table] | None = None) -> Table:
    """Return the proof of |y|² ≤ 0.1 by V = x² − 0.1 f2²."""
    found = terms or [{"matrix": "X", "on": [0], "times": 1}, {"square": "f2", "times": -0.1}]
    bound = {
        "output": "y", "from": "start", "decay": 1, "levels": [0, 0.1], "matrices": {"X": [[1]]},
        "forms": {"a": {"nodes": [0, 1], "terms": [found, found]}}, "multipliers": {},
    }  # fmt: skip
    return {"format": "noack-forms 1", "bounds": [bound]}


def test_a_document_with_noise_that_nothing_reads_is_proven() -> None:
    assert str(proven(noisy([[-1, 0, 0]], [[1, 0, 0]]), bound_of_x())[0]) == "|y| ≤ 0.316228 at all times"


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(noisy([[-1, 1, 0]], [[1, 0, 0]]), id="a motion reads noise"),
        pytest.param(noisy([[-1, 0, 0]], [[1, 1, 0]]), id="an output reads noise"),
        pytest.param(noisy([[-1, 0, 0]], [[1, 0, 0]], [[1, 1, 0]]), id="a jump reads noise"),
    ],
)
def test_noise_that_no_fact_bounds_stays_in_the_inequalities(document: Table) -> None:
    with pytest.raises(RejectedError, match="not proven at"):
        proven(document, bound_of_x())


def test_a_form_has_no_noise() -> None:
    document = noisy([[-1, 0, 0]], [[1, 0, 0]])
    square = [{"square": "x and n", "times": 1}, {"square": "f2", "times": -0.1}]
    matrix = [{"matrix": "X", "on": [1], "times": 1}, {"square": "f2", "times": -0.1}]
    with pytest.raises(RejectedError, match="noise has a part in it"):
        proven(document, bound_of_x(square))
    with pytest.raises(RejectedError, match="a coordinate that the location lacks"):
        proven(document, bound_of_x(matrix))


def test_noise_of_a_location_says_nothing_of_an_edge() -> None:
    document = noisy([[-1, 0, 0]], [[1, 0, 0]], [[1, 0.01, 0]])
    document["facts"]["small"] = {"less": ["n"], "more": ["f2"], "words": ""}
    document["locations"][0]["facts"] = ["small"]
    proof = bound_of_x()
    proof["bounds"][0]["multipliers"]["edge/e/0 0"] = {"facts": {"small": 1}}
    with pytest.raises(RejectedError, match="does not hold here"):
        proven(document, proof)


def test_a_dead_edge_is_proven_to_be_never_taken() -> None:
    """V ≤ 0 excludes |x|² ≥ f2²."""
    document, proof = noisy([[-1, 0, 0]], [[1, 0, 0]]), bound_of_x()
    document["rows"]["x"] = [[1, 0, 0]]
    document["facts"]["far"] = {"less": ["f2"], "more": ["x"], "words": ""}
    dead = {"name": "far", "from": "a", "to": None, "when": [0, 1], "clock": "zero", "facts": ["far"]}
    document["edges"].append(dead)
    for node in (0, 1):
        proof["bounds"][0]["multipliers"][f"edge/far/{node}"] = {"facts": {"far": 1}, "above": {"f2": 0.5}}
    proven(document, proof)
    proof["bounds"][0]["multipliers"]["edge/far/1"]["above"]["f2"] = 0.95
    with pytest.raises(RejectedError, match="not proven at edge/far/1"):
        proven(document, proof)


def test_a_form_without_nodes_is_tested_at_all_nodes_of_a_target_whose_clock_goes_on() -> None:
    document = noisy([[0, 0, 0]], [[1, 0, 0]])
    document["locations"].append(document["locations"][0] | {"name": "b"})
    document["edges"][0] |= {"to": "b", "clock": "keeps"}
    proof = bound_of_x()
    forms = proof["bounds"][0]["forms"]
    small, large = (
        [{"square": "f2", "times": -size}, {"matrix": "X", "on": [0], "times": 1}] for size in (0.05, 0.1)
    )
    forms |= {"a": {"nodes": [0], "terms": [large]}, "b": {"nodes": [0, 1], "terms": [large, small]}}
    proof["bounds"][0]["decay"] = 0
    with pytest.raises(RejectedError, match="not proven at"):
        proven(document, proof)


# What is printed, and what may jump at a limit.


def unit_alone(rate: float, level: str, **output: Any) -> tuple[Table, Table]:
    """Return a document of y = f1 = e^{−rt} alone, and a proof of y² ≤ level · f1² by V = −f1²/10²⁰⁰."""
    document = {
        "format": "noack-hybrid 1", "name": "unit", "coordinates": [{"name": "f1", "unit": ""}],
        "decaying": {"coordinate": "f1", "rate": rate}, "rows": {"f1": [[1]]}, "facts": {},
        "motions": {"m": [{"matrix": [[-rate]], "input": [], "unknown": []}]},
        "locations": [{"name": "a", "coordinates": [], "motion": "m", "facts": []}], "edges": [],
        "start": {"location": "a", "columns": [[1]], "facts": []},
        "outputs": [{"name": "y", "unit": "", "rows": [[1]], "in": ["a"]} | output],
    }  # fmt: skip
    bound = {
        "output": output.get("name", "y"), "from": "start", "decay": 3, "levels": [level, 0], "matrices": {},
        "forms": {"a": {"nodes": [0], "terms": [[{"square": "f1", "times": "-1/1" + "0" * 200}]]}},
        "multipliers": {},
    }  # fmt: skip
    return document, {"format": "noack-forms 1", "bounds": [bound]}


@pytest.mark.parametrize(
    ("rate", "shown"),
    [(0.9999996, "0.999999"), (0.1234567, "0.123456"), (0.3, "0.3"), (1e-9, "1e-9")],
)
def test_a_printed_rate_is_at_most_the_proven_one(rate: float, shown: str) -> None:
    assert str(proven(*unit_alone(rate, "5/4"))[0]) == f"|y| ≤ 1.11804 e^(−{shown} t) at all times"


@pytest.mark.parametrize(
    ("level", "shown"), [("1/1" + "0" * 190, "1e-95"), ("1/2" + "0" * 399, "2.23607e-200"), ("4/1", "2")]
)
def test_a_printed_bound_is_at_least_the_proven_one(level: str, shown: str) -> None:
    """The smallest ones are no floating-point numbers."""
    rows = {"rows": [[1 if level == "4/1" else 0]]}
    document, proof = unit_alone(0.3, level, **rows)
    proof["bounds"][0]["forms"]["a"]["terms"][0][0]["times"] = "-1/1" + "0" * 600
    text = str(proven(document, proof)[0])
    assert text.startswith("|y| ≤ ")
    number = text.removeprefix("|y| ≤ ").split(" ")[0]
    top, bottom = level.split("/")
    assert Decimal(number) ** 2 * Decimal(bottom) >= Decimal(top)
    assert float(Decimal(number)) == pytest.approx(float(shown), rel=1e-5, abs=0)


def test_a_name_or_a_unit_that_reads_like_a_statement_is_quoted() -> None:
    spoof = {"name": "x| ≤ 0 at all times; |y", "unit": "m in the limit"}
    text = str(proven(*unit_alone(0.3, "5/4", **spoof))[0])
    assert text == "|'x| ≤ 0 at all times; |y'| ≤ 1.11804 e^(−0.3 t) 'm in the limit' at all times"
    plain = {"name": "error of the controller's model", "unit": "m/s²"}
    text = str(proven(*unit_alone(0.3, "5/4", **plain))[0])
    assert text == "|error of the controller's model| ≤ 1.11804 e^(−0.3 t) m/s² at all times"


@pytest.mark.parametrize("value", [3, None, "1/2", {"1/2": 1}])
def test_multipliers_of_signals_are_a_list(value: object) -> None:
    document, proof = unit_alone(0.3, "5/4")
    proof["bounds"][0]["multipliers"]["motion/a/0"] = {"unknown": value}
    with pytest.raises(RejectedError, match="multipliers of signals are no list"):
        proven(document, proof)


def test_a_limit_is_one_of_an_output_that_does_not_jump_between_edges() -> None:
    """|y| < 2 up to a time says nothing of the next moment, where noise or another corner makes it 3."""
    document = noisy([[-1, 0, 0]], [[1, 0, 0]])
    document["while"] = [{"output": "y", "less": 1}]
    proven(document, bound_of_x())
    document["outputs"][0]["rows"] = [[1, 1, 0]]
    with pytest.raises(RejectedError, match="may jump at any time"):
        proven(document, bound_of_x())
    corner = document["motions"]["m"][0] | {"input": [[0.5, 0, 0]]}
    del document["outputs"][0]["rows"]
    document["outputs"][0]["input"] = 0
    document["motions"]["m"] = [corner, corner]
    proven(document, bound_of_x())
    document["motions"]["m"] = [corner, corner | {"input": [[0.4, 0, 0]]}]
    with pytest.raises(RejectedError, match="may jump at any time"):
        proven(document, bound_of_x())


def test_files_are_json_of_exact_numbers() -> None:
    document, proof = pendulum()
    assert json.loads(as_text(document)) == document
    assert json.loads(as_text(proof)) == proof


def test_a_folder_is_refused_by_its_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert verify(tmp_path, tmp_path) == UNREADABLE
    assert capsys.readouterr().err == f"noack-check: {tmp_path}: not a regular file\n"


def test_bounds_beyond_floating_point_are_rounded_outwards() -> None:
    """A float of such a number is infinite."""
    large = fmpq(13) * fmpq(10) ** 399
    assert str(root_above(large * large)) == "1.30001E+400"


def test_an_interval_is_shown_with_its_ends() -> None:
    """Also one around 0, and one around what changes nothing: the text hides nothing that may happen."""
    document, _ = pendulum()
    corner, edge = document["motions"]["driven"][0], entry(document, "edges", "0 lost, silent")
    corner["matrix"][0][0] = [-2, 2]
    edge["jump"][1][1] = [0.5, 1.5]
    document["start"]["columns"][0][0] = [-0.25, 0.25]
    text = re.sub(r"\s+", " ", in_words(document))
    assert "- d/dt x0 = [−2, 2] x0 + x1 " in text
    assert re.search(r"- '0 lost, silent': [^-]*; x1 := \[0\.5, 1\.5\] x1 - ", text)
    assert "with x0 = [−0.25, 0.25]" in text
