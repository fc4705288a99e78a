"""Forms that use each other (R6), times between events (R10), bounds of rows (R11), in documents by hand."""

import copy
import math
from collections.abc import Callable
from typing import Any

import pytest

from noack.proof.forms_proof import as_text
from noack_kernel import Proven, RejectedError, prove

Table = dict[str, Any]
Change = Callable[[Table, Table], None]


def proven(document: Table, proof: Table) -> Proven:
    """Return what a proof proves."""
    return prove(as_text(document), as_text(proof))


# Two states that push each other: |x| ≤ 1 needs |y| ≤ 1, and the other way round.


def coupled(push: float = 0.5) -> tuple[Table, Table]:
    """Return ẋ = −x + push y and ẏ = −y + push x, and the proof of |x| ≤ 1 and |y| ≤ 1 by one form each."""
    still = [0, 0, 0]
    document: Table = {
        "format": "noack-hybrid 1", "name": "coupled",
        "coordinates": [{"name": name, "unit": ""} for name in ("x", "y", "f2")],
        "constant": "f2", "rows": {"f2": [[0, 0, 1]]}, "facts": {},
        "motions": {"m": [{"matrix": [[-1, push, 0], [push, -1, 0], still], "input": [], "unknown": []}]},
        "locations": [{"name": "a", "coordinates": ["x", "y"], "clock": 2, "motion": "m", "facts": []}],
        "edges": [
            {
                "name": "e", "from": "a", "to": "a", "when": [0, 2], "clock": "zero", "facts": [],
                "jump": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
            }
        ],
        "start": {"location": "a", "columns": [[1], [-1], [1]], "facts": []},
        "outputs": [
            {"name": "x", "unit": "", "rows": [[1, 0, 0]], "in": ["a"]},
            {"name": "y", "unit": "", "rows": [[0, 1, 0]], "in": ["a"]},
        ],
    }  # fmt: skip

    def bound(output: str, other: str, on: int) -> Table:
        terms = [{"matrix": "X", "on": [on], "times": 1}, {"square": "f2", "times": -1}]
        pieces = {f"motion/a/piece {piece}": {"forms": {other: push}} for piece in (0, 1)}
        return {
            "output": output, "from": "start", "decay": 1.99 - push, "levels": [0, 1.0001],
            "matrices": {"X": [[1]]},
            "forms": {"a": {"nodes": [0, 1, 2], "terms": [terms] * 3}}, "multipliers": pieces,
        }  # fmt: skip

    return document, {"format": "noack-forms 1", "bounds": [bound("x", "y", 0), bound("y", "x", 1)]}


def test_two_forms_prove_bounds_that_need_each_other() -> None:
    assert proven(*coupled()).sentences == ["|x| ≤ 1.00005 at all times", "|y| ≤ 1.00005 at all times"]
    assert proven(*coupled(0.9)).bounds


def push_harder(document: Table, proof: Table) -> None:
    """x and y grow then."""
    document["motions"]["m"][0]["matrix"][0][1] = 1.5


def need_nothing_of_the_other(document: Table, proof: Table) -> None:
    proof["bounds"][0]["multipliers"] = {}


def need_it_on_one_piece_only(document: Table, proof: Table) -> None:
    del proof["bounds"][0]["multipliers"]["motion/a/piece 1"]


def subtract_the_other(document: Table, proof: Table) -> None:
    proof["bounds"][0]["multipliers"]["motion/a/piece 0"]["forms"]["y"] = -0.5


def use_a_form_that_is_not_there(document: Table, proof: Table) -> None:
    del proof["bounds"][1]


def use_a_form_in_the_limit(document: Table, proof: Table) -> None:
    """It is not below 0 at the start."""
    proof["bounds"][1]["from"] = "limit"


def use_other_nodes(document: Table, proof: Table) -> None:
    form = proof["bounds"][1]["forms"]["a"]
    form |= {"nodes": [0, 2], "terms": form["terms"][:2]}
    proof["bounds"][1]["multipliers"].popitem()


def begin_above(document: Table, proof: Table) -> None:
    """R3 fails for the other form."""
    document["start"]["columns"][1] = [1.1]


def use_its_own_form(document: Table, proof: Table) -> None:
    proof["bounds"][0]["multipliers"]["motion/a/piece 0"]["forms"]["x"] = 1


def jump_with_the_other(document: Table, proof: Table) -> None:
    """x := x + y: V grows, and the other form does not help."""
    document["edges"][0]["jump"][0] = [1, 1, 0]
    proof["bounds"][0]["multipliers"]["edge/e/piece 0"] = {"forms": {"y": 2}}


R6_FAULTS: dict[Change, str] = {
    push_harder: "x: not proven at motion/a/0",
    need_nothing_of_the_other: "x: not proven at motion/a/0",
    need_it_on_one_piece_only: "x: not proven at motion/a/1",
    subtract_the_other: "a multiplier below 0",
    use_a_form_that_is_not_there: "no other form 'y' from the start on",
    use_a_form_in_the_limit: "no other form 'y' from the start on",
    use_other_nodes: "other nodes in a",
    begin_above: "y: not proven at start",
    use_its_own_form: "no other form 'x' from the start on",
    jump_with_the_other: "x: not proven at edge/e/0 0",
}


@pytest.mark.parametrize("change", R6_FAULTS, ids=lambda change: change.__name__)
def test_forms_that_use_each_other_wrongly_are_rejected(change: Change) -> None:
    document, proof = copy.deepcopy(coupled())
    change(document, proof)
    with pytest.raises(RejectedError, match=R6_FAULTS[change]):
        proven(document, proof)


def test_a_lemma_is_used_by_a_bound_that_has_no_form_of_its_own() -> None:
    """|x + y| ≤ 2 follows from |x| ≤ 1 and |y| ≤ 1: 2 V₁ + 2 V₂ + 4 f2² − (x + y)² = (x − y)²."""
    document, proof = coupled()
    document["outputs"].append({"name": "sum", "unit": "", "rows": [[1, 1, 0]], "in": ["a"]})
    lemmas = [
        {"name": bound["output"], **{k: v for k, v in bound.items() if k not in ("output", "from", "levels")}}
        for bound in proof["bounds"]
    ]
    numbers = {f"output/a/piece {piece}": {"forms": {"x": 2.001, "y": 2.001}} for piece in (0, 1)}
    bound = {
        "output": "sum", "from": "start", "decay": 0, "levels": [0, 4.01], "matrices": {},
        "forms": {"a": {"nodes": [0, 1, 2], "terms": [[], [], []]}}, "multipliers": numbers,
    }  # fmt: skip
    proof = {"format": "noack-forms 1", "lemmas": lemmas, "bounds": [bound]}
    assert proven(document, proof).sentences == ["|sum| ≤ 2.00250 at all times"]
    bound["levels"] = [0, 3.9]
    with pytest.raises(RejectedError, match="sum: not proven at output/a/0"):
        proven(document, proof)


# An error e with ė = e + p, |p| ≤ 1, that an event sets to 0, and that is 2 at an event.

REACHES_2_S = math.log(3)
"""e^t − 1 = 2."""


def growing(apart: float = 1.0986, when: float = 1.0) -> tuple[Table, Table]:
    """Return the document, and the proof that events are some time apart and none is early in "waiting"."""
    jump = [[0, 0], [0, 1]]
    event = {"facts": ["exceeded"], "jump": jump, "clock": "zero", "event": True, "when": [0, 1]}
    document: Table = {
        "format": "noack-hybrid 1", "name": "growing",
        "coordinates": [{"name": "e", "unit": ""}, {"name": "f2", "unit": ""}],
        "constant": "f2", "rows": {"e": [[1, 0]], "2 f2": [[0, 2]]},
        "facts": {"exceeded": {"less": ["2 f2"], "more": ["e"], "words": "an event"}},
        "motions": {
            "m": [
                {
                    "matrix": [[1, 0], [0, 0]], "input": [],
                    "unknown": [{"column": [[1], [0]], "rows": [[0, 1]]}],
                }
            ]
        },
        "locations": [
            {"name": name, "coordinates": ["e"], "clock": 1, "motion": "m", "facts": []}
            for name in ("tested", "waiting")
        ],
        "edges": [
            {"name": "sent", "from": "tested", "to": "waiting", **event},
            {"name": "lost", "from": "tested", "to": "tested", **event},
            {
                "name": "silent", "from": "tested", "to": "tested", "when": [0, 1], "clock": "zero",
                "facts": [], "jump": [[1, 0], [0, 1]],
            },
            {
                "name": "arrives", "from": "waiting", "to": "tested", "when": [0, 1], "clock": "any",
                "facts": [], "jump": [[1, 0], [0, 1]],
            },
            {
                "name": "early", "from": "waiting", "to": None, "when": [0, when], "clock": "zero",
                "facts": ["exceeded"],
            },
        ],
        "start": {"location": "tested", "columns": [[0], [1]], "facts": []},
        "outputs": [
            {"name": "push", "unit": "", "rows": [[1, 0]], "velocity": [[-1, 0]], "in": ["tested", "waiting"]}
        ],
    }  # fmt: skip
    places = ("tested", "waiting")
    bound = {
        "output": "push", "from": "start", "decay": 0, "levels": [0, 1], "matrices": {},
        "forms": {name: {"nodes": [0], "terms": [[]]} for name in places},
        "multipliers": {f"output/{name}/0": {"unknown": [1]} for name in places},
    }  # fmt: skip
    entry = {"output": "push", "matrix": [[1]], "after": [0, 0], "reach": [0, 3.9999]}
    of_event = {"facts": {"exceeded": 1}, "above": {"f2": 0.0001}}
    times = [
        {**entry, "apart": apart, "multipliers": {"edge/sent": of_event, "edge/lost": of_event}},
        {**entry, "never": ["early"], "multipliers": {"edge/early": of_event}},
    ]
    return document, {"format": "noack-forms 1", "bounds": [bound], "times": times}


def test_two_events_are_as_far_apart_as_the_error_needs() -> None:
    """The bounds of the exponential on 64 cells cost a per cent."""
    assert proven(*growing(0.98 * REACHES_2_S)).sentences == [
        "|push| ≤ 1 at all times",
        "two events are at least 1.07664 s apart, the start counted as one",
        "the edge 'early' is never taken",
    ]


def wait_longer(document: Table, proof: Table) -> None:
    proof["times"][0]["apart"] = 1.01 * REACHES_2_S


def grow_faster(document: Table, proof: Table) -> None:
    document["motions"]["m"][0]["matrix"][0][0] = 1.1


def be_pushed_harder(document: Table, proof: Table) -> None:
    document["motions"]["m"][0]["unknown"][0]["rows"] = [[0, 1.05]]


def need_less(document: Table, proof: Table) -> None:
    """An event needs an error of 1.9 only."""
    document["rows"]["2 f2"] = [[0, 1.9]]


def reset_to_something_else(document: Table, proof: Table) -> None:
    document["edges"][1]["jump"] = [[0.1, 0], [0, 1]]


def change_the_error_without_an_event(document: Table, proof: Table) -> None:
    document["edges"][2]["jump"] = [[1, 0.1], [0, 1]]


def count_no_event(document: Table, proof: Table) -> None:
    """The edge that is no event sets the error to 0."""
    document["edges"][1]["event"] = False


def claim_more_growth_is_none(document: Table, proof: Table) -> None:
    proof["times"][0]["matrix"] = [[0.9]]


def reach_less(document: Table, proof: Table) -> None:
    proof["times"][0]["reach"] = [0, 3.4]


def arrive_in_the_waiting_location(document: Table, proof: Table) -> None:
    """Then the clock does not show the time since the last event."""
    document["edges"][3]["to"] = "waiting"


def start_while_waiting(document: Table, proof: Table) -> None:
    document["start"]["location"] = "waiting"


def start_with_more(document: Table, proof: Table) -> None:
    """The start counts as an event, and is none that resets the error."""
    document["start"]["columns"][0] = [0.1]


def wait_for_a_longer_time(document: Table, proof: Table) -> None:
    document["locations"][1]["clock"] = 1.2
    document["edges"][4]["when"] = [0, 1.2]


def exclude_nothing(document: Table, proof: Table) -> None:
    del proof["times"][1]


def exclude_no_edge(document: Table, proof: Table) -> None:
    proof["times"][1]["never"] = []


def leave_out_the_margin(document: Table, proof: Table) -> None:
    proof["times"][0]["multipliers"]["edge/lost"] = {"facts": {"exceeded": 1}}


R10_FAULTS: dict[Change, str] = {
    wait_longer: "may reach more within the time",
    grow_faster: "not proven at output",
    be_pushed_harder: "not proven at output",
    need_less: "not proven at edge/sent",
    reset_to_something_else: "not proven at after/lost",
    change_the_error_without_an_event: "silent changes the rows",
    count_no_event: "lost changes the rows",
    claim_more_growth_is_none: "is not −Rż",
    reach_less: "may reach more within the time",
    arrive_in_the_waiting_location: "waiting is entered without an event",
    start_with_more: "not proven at the start",
    start_while_waiting: "waiting is entered without an event",
    wait_for_a_longer_time: "may reach more within the time",
    exclude_nothing: "early leads nowhere, and is not proven",
    exclude_no_edge: "is no edge that leads nowhere",
    leave_out_the_margin: "not proven to be never taken",
}


@pytest.mark.parametrize("change", R10_FAULTS, ids=lambda change: change.__name__)
def test_a_time_between_events_that_is_not_proven_is_rejected(change: Change) -> None:
    document, proof = copy.deepcopy(growing(0.98 * REACHES_2_S))
    change(document, proof)
    with pytest.raises(RejectedError, match=R10_FAULTS[change]):
        proven(document, proof)


# Rows with bounds by norms: e with ė = −p and |p| ≤ 1 between tests, and w that an event increases by e.

LEVEL = 2.0
"""A silent test leaves |e| at most 2."""


def errors() -> tuple[Table, Table]:
    """Return a document with two losses, and the proof of |e| ≤ 2.2, |w| ≤ 2.2 or 4.4, and |e + w| ≤ 6.6."""
    still = [0, 0, 0]
    stays = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
    adds = [[0, 0, 0], [1, 1, 0], [0, 0, 1]]
    resets = [[0, 0, 0], [0, 0, 0], [0, 0, 1]]
    tested = {"when": [0, 0.1], "clock": "zero"}
    document: Table = {
        "format": "noack-hybrid 1", "name": "errors",
        "coordinates": [{"name": name, "unit": ""} for name in ("e", "w", "f2")],
        "constant": "f2", "rows": {"e": [[1, 0, 0]], "level": [[0, 0, LEVEL]]},
        "facts": {
            "silent": {"less": ["e"], "more": ["level"], "words": "no event"},
            "event": {"less": ["level"], "more": ["e"], "words": "an event"},
        },
        "motions": {
            "m": [
                {
                    "matrix": [still, still, still], "input": [],
                    "unknown": [{"column": [[-1], [0], [0]], "rows": [[0, 0, 1]]}],
                }
            ]
        },
        "locations": [
            {
                "name": f"{j} lost", "coordinates": ["e", "w"] if j else ["e"], "clock": 0.1, "motion": "m",
                "facts": [],
            }
            for j in range(3)
        ],
        "edges": [
            *(
                {
                    "name": f"{j} silent", "from": f"{j} lost", "to": f"{j} lost", "facts": ["silent"],
                    "jump": stays, **tested,
                }
                for j in range(3)
            ),
            *(
                {
                    "name": f"{j} delivered", "from": f"{j} lost", "to": "0 lost", "facts": ["event"],
                    "jump": resets, "event": True, **tested,
                }
                for j in range(3)
            ),
            *(
                {
                    "name": f"{j} lost", "from": f"{j} lost", "to": f"{j + 1} lost", "facts": ["event"],
                    "jump": adds, "event": True, **tested,
                }
                for j in range(2)
            ),
        ],
        "start": {"location": "0 lost", "columns": [[0], [0], [1]], "facts": []},
        "outputs": [
            {
                "name": "push", "unit": "", "rows": [[0, 0, 0]], "velocity": [[-1, 0, 0]],
                "in": ["0 lost", "1 lost", "2 lost"],
            },
            {"name": "sum", "unit": "", "rows": [[1, 1, 0]], "in": ["0 lost", "1 lost", "2 lost"]},
        ],
    }  # fmt: skip
    places = [f"{j} lost" for j in range(3)]
    nothing = {name: {"nodes": [0], "terms": [[]]} for name in places}
    no_form = {"from": "start", "decay": 0, "matrices": {}, "forms": nothing}
    push = {
        "output": "push", "levels": [0, 1], **no_form,
        "multipliers": {f"output/{name}/0": {"unknown": [1]} for name in places},
    }  # fmt: skip
    total = {
        "output": "sum", "levels": [0, 43.6], **no_form,
        "multipliers": {
            "output/0 lost/0": {"facts": {"of e": 1.0001}},
            **{
                f"output/{j} lost/0": {"facts": {"of e": 1.0001 * (1 + j), "of w": 1.0001 * (1 + 1 / j)}}
                for j in (1, 2)
            },
        },
    }  # fmt: skip
    of_e = {
        "name": "of e", "rows": [[1, 0, 0]], "matrix": [[0]], "output": "push",
        "in": {name: {"enter": [0, 4.001], "within": [0, 4.84], "split": 0.05} for name in places},
        "multipliers": {f"edge/{j} silent": {"facts": {"silent": 1}} for j in range(3)},
    }  # fmt: skip
    sizes = [0, 4.841, 19.38]
    of_w = {
        "name": "of w", "rows": [[0, 1, 0]], "matrix": [[0]],
        "in": {name: {"enter": [0, a], "within": [0, a]} for name, a in zip(places, sizes, strict=True)},
        "multipliers": {
            "edge/1 silent": {"facts": {"of w": 1}}, "edge/2 silent": {"facts": {"of w": 1}},
            "edge/0 lost": {"facts": {"of e": 1.00001}},
            "edge/1 lost": {"facts": {"of e": 2.0001, "of w": 2.0001}},
        },
    }  # fmt: skip
    return document, {"format": "noack-forms 1", "bounds": [push, total], "rows": [of_e, of_w]}


def test_rows_have_bounds_by_norms_which_forms_use() -> None:
    assert proven(*errors()).sentences == ["|push| ≤ 1 at all times", "|sum| ≤ 6.60303 at all times"]


def be_silent_at_more(document: Table, proof: Table) -> None:
    document["rows"]["level"] = [[0, 0, 2.01]]


def push_more(document: Table, proof: Table) -> None:
    document["motions"]["m"][0]["unknown"][0]["rows"] = [[0, 0, 1.1]]


def wait_longer_between_tests(document: Table, proof: Table) -> None:
    for location in document["locations"]:
        location["clock"] = 0.2


def never_test(document: Table, proof: Table) -> None:
    del document["locations"][1]["clock"]


def add_more(document: Table, proof: Table) -> None:
    """w := w + 1.01 e."""
    document["edges"][7]["jump"] = [[0, 0, 0], [1.01, 1, 0], [0, 0, 1]]


def move_w(document: Table, proof: Table) -> None:
    document["motions"]["m"][0]["matrix"][1] = [0, -0.1, 0]


def push_w(document: Table, proof: Table) -> None:
    document["motions"]["p"] = copy.deepcopy(document["motions"]["m"])
    document["motions"]["p"][0]["unknown"][0]["column"] = [[-1], [0.001], [0]]
    for location in document["locations"][1:]:
        location["motion"] = "p"


def lose_one_more(document: Table, proof: Table) -> None:
    """From "2 lost" to itself: w is not bounded any more."""
    edge = copy.deepcopy(document["edges"][7])
    document["edges"].append(edge | {"name": "2 lost", "from": "2 lost", "to": "2 lost"})
    proof["rows"][1]["multipliers"]["edge/2 lost"] = {"facts": {"of e": 3.0001, "of w": 1.50001}}


def start_with_an_error(document: Table, proof: Table) -> None:
    document["start"]["columns"][0] = [2.1]


def use_a_bound_where_there_is_none(document: Table, proof: Table) -> None:
    del proof["rows"][0]["in"]["2 lost"]


def take_the_name_of_a_fact(document: Table, proof: Table) -> None:
    proof["rows"][0]["name"] = "silent"


def leave_no_room(document: Table, proof: Table) -> None:
    """At the time of a test the row may be at its bound, not below it."""
    for place in proof["rows"][0]["in"].values():
        place["within"] = place["enter"]


def need_a_bound_that_is_not_proven(document: Table, proof: Table) -> None:
    proof["bounds"][0]["from"] = "limit"
    proof["bounds"][0]["decay"] = 1


R11_FAULTS: dict[Change, str] = {
    be_silent_at_more: "of e: not proven at edge/0 silent",
    push_more: "not proven at output",
    wait_longer_between_tests: "of e in 0 lost: it may exceed the bound",
    never_test: "of e in 1 lost: it may exceed the bound, or the clock has no limit",
    add_more: "of w: not proven at edge/1 lost",
    move_w: "of w in 1 lost: the rows move in another way",
    push_w: "of w in 1 lost: the rows move in another way",
    lose_one_more: "of w: not proven at edge/2 lost",
    start_with_an_error: "of e: not proven at start",
    use_a_bound_where_there_is_none: "of e has no bound in 2 lost",
    take_the_name_of_a_fact: "the name of another one, or of a fact",
    leave_no_room: "of e in 0 lost: it may exceed the bound",
    need_a_bound_that_is_not_proven: "push has no bound from the start on",
}


@pytest.mark.parametrize("change", R11_FAULTS, ids=lambda change: change.__name__)
def test_a_bound_of_rows_that_is_not_proven_is_rejected(change: Change) -> None:
    document, proof = copy.deepcopy(errors())
    change(document, proof)
    with pytest.raises(RejectedError, match=R11_FAULTS[change]):
        proven(document, proof)


# A row that is still, with a bound that decays.


def still(most: float = 1.001, rate: float = 1.0, moves: bool = True) -> tuple[Table, Table]:
    """Return ẋ = 0, x(0) = 1, and the proof of |x| ≤ f1 · √most for one second."""
    document: Table = {
        "format": "noack-hybrid 1", "name": "still",
        "coordinates": [{"name": "x", "unit": ""}, {"name": "f1", "unit": ""}],
        "decaying": {"coordinate": "f1", "rate": rate}, "rows": {}, "facts": {},
        "motions": {"m": [{"matrix": [[0, 0], [0, -rate]], "input": [], "unknown": []}]},
        "locations": [
            {
                "name": "a", "coordinates": ["x"], "facts": [],
                **({"motion": "m", "clock": 1} if moves else {"motion": None}),
            }
        ],
        "edges": [],
        "start": {"location": "a", "columns": [[1], [1]], "facts": []},
        "outputs": [{"name": "x", "unit": "", "rows": [[1, 0]], "in": ["a"]}],
    }  # fmt: skip
    bound = {
        "output": "x", "from": "start", "decay": 0, "levels": [1.0001 * most, 0], "matrices": {},
        "forms": {"a": {"nodes": [0], "terms": [[]]}},
        "multipliers": {"output/a/0": {"facts": {"of x": 1}}},
    }  # fmt: skip
    rows = {
        "name": "of x", "rows": [[1, 0]], "matrix": [[0]],
        "in": {"a": {"enter": [1.0005, 0], "within": [most, 0]}}, "multipliers": {},
    }  # fmt: skip
    return document, {"format": "noack-forms 1", "bounds": [bound], "rows": [rows]}


def test_a_row_that_is_still_does_not_decay() -> None:
    with pytest.raises(RejectedError, match="of x in a: it may exceed the bound"):
        proven(*still())
    with pytest.raises(RejectedError, match="of x in a: it may exceed the bound"):
        proven(*still(0.99 * math.exp(2)))
    assert proven(*still(1.02 * math.exp(2))).bounds
    assert proven(*still(rate=0)).bounds
    assert proven(*still(moves=False)).bounds
