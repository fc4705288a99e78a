"""The kernel on documents without motions: a drive written by hand, false documents and false proofs."""

import copy
import functools
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from noack.core.linear_systems import Vector
from noack.proof.forms_proof import as_text
from noack.proof.period_graph import PeriodGraph
from noack.theory.witnesses.period_bounds import BoundSearch
from noack.theory.witnesses.period_growth import GrowthSearch
from noack_kernel import GrowthStatement, RejectedError, Statement, prove
from tests.checker.drive_document import START, drive

Table = dict[str, Any]
Change = Callable[[Table, Table], None]
RATE, LOAD = 2.0, 50.0
STEPS = 10
"""Of the simulation, in a period: 1 ms each."""


def proven(document: Table, proof: Table) -> tuple[list[Statement], list[GrowthStatement]]:
    found = prove(as_text(document), as_text(proof))
    return found.bounds, found.growth


def proof_of(*bounds: Table, growth: list[Table] | None = None) -> Table:
    return {
        "format": "noack-forms 1",
        "bounds": list(bounds),
        **({} if growth is None else {"growth": growth}),
    }


@functools.cache
def bounded(losses: int = 2, load: float = LOAD) -> tuple[Table, Table]:
    document = drive(losses, rate=RATE, load=load)
    bound = BoundSearch(PeriodGraph(document)).bound("speed", 10.0)
    assert bound is not None
    return document, proof_of(bound)


@functools.cache
def growing(losses: int) -> tuple[Table, Table]:
    """Return a document with a proof of its growth, at most and at least."""
    document = drive(losses)
    search = GrowthSearch(PeriodGraph(document))
    cycle = search.cycle
    assert cycle is not None
    least = search.at_least(cycle, 1e-6)
    most = next(filter(None, (search.at_most(cycle.growth * (1 + gap)) for gap in (0.0042, 0.016))))
    assert least is not None
    return document, proof_of(growth=[least, most])


# An independent simulation: the PLC in steps of 1 ms, with its queue of packets.


def simulated(outcomes: str, loads: Vector, start: float = 1.0) -> Vector:
    """Return the speed every 0.1 ms; packets arrive E (early) or L (late), or are lost (X)."""
    speed, current, integral, received, voltage = (start * v for v in START.values())
    queue, found = [start * -100.0] * 3, list[float]()
    F = np.zeros((4, 4))
    F[0], F[1] = [-0.5, 250, 0, 1], [-50, -500, 1000, 0]
    fine = expm(F * 1e-4)
    for outcome, load in zip(outcomes, loads, strict=True):
        queue = [speed, *queue[:2]]
        for step in range(STEPS):
            if step == 5:
                used = queue[2] if outcome == "E" else received
                integral -= 0.01 * used
                command = -0.024 * used + 0.6 * integral
                if outcome != "X":
                    received = queue[2]
            if step == 6:
                voltage = command
            for _ in range(10):
                found.append(speed)
                speed, current, *_ = fine @ [speed, current, voltage, load]
    return np.array(found)


def outcomes_of(rng: np.random.Generator, periods: int, losses: int) -> str:
    found = ""
    while len(found) < periods:
        found += "X" * int(rng.integers(0, losses + 1)) + str(rng.choice(["E", "L"]))
    return found[:periods]


def test_no_simulated_run_exceeds_what_is_proven_of_the_drive() -> None:
    (bound,), _ = proven(*bounded())
    assert str(bound).endswith(" rad/s at all times")
    rng, nearest = np.random.default_rng(1), 0.0
    t = np.arange(100 * STEPS * 10) * 1e-4
    limit = float(bound.decaying) * np.exp(-RATE * t) + float(bound.constant)
    for _ in range(30):
        outcomes = outcomes_of(rng, 100, 2)
        loads = LOAD * np.sign(np.sin(2 * np.pi * np.arange(100) * rng.uniform(0.0, 0.3)) + 1e-9)
        share = np.abs(simulated(outcomes, loads)) / limit
        assert share.max() < 1
        nearest = max(nearest, float(share.max()))
    assert nearest > 0.8


def test_eleven_losses_in_a_row_are_stable_and_twelve_are_not() -> None:
    """There is no gap; one of either outcomes of a tie alone would allow twelve."""
    _, (_, most) = proven(*growing(11))
    assert most.is_upper
    assert most.factor < 1
    _, (least, _) = proven(*growing(12))
    assert not least.is_upper
    assert least.factor > 1
    assert str(least).startswith(
        "the difference of two runs with the same loads grows at least by the factor 1.002"
    )
    letters = {"early": "E", "late": "L", "lost": "X"}
    outcomes = "".join(letters[name.split(", ")[1]] for name in least.cycle)
    rounds = 2000 // len(outcomes)
    run = np.abs(simulated(outcomes * rounds, np.zeros(rounds * len(outcomes))))
    half = len(run) // 2
    growth = (run[half:].max() / run[:half].max()) ** (1 / (half / (10 * STEPS)))
    assert growth == pytest.approx(float(least.factor), rel=2e-3)


def test_a_smaller_part_of_a_document_has_statements_of_its_own() -> None:
    document, kept = drive(3), ["0 lost", "1 lost"]
    search = GrowthSearch(PeriodGraph(document, kept))
    entry = search.at_most(0.88)
    assert entry is not None
    _, (growth,) = proven(document, proof_of(growth=[entry]))
    assert str(growth) == (
        "the difference of two runs with the same loads grows at most by the factor 0.88 per 0.01 s in the "
        "long run, for runs that visit only '0 lost', '1 lost': stable"
    )
    with pytest.raises(RejectedError, match="not proven of paths"):
        proven(document, proof_of(growth=[entry | {"only": [*kept, "2 lost", "3 lost"]}]))
    with pytest.raises(RejectedError, match="unknown name"):
        proven(document, proof_of(growth=[entry | {"only": [*kept, "4 lost"]}]))


# Documents and proofs with one fault.


def step(document: Table, name: str) -> list[list[Any]]:
    rows: list[list[Any]] = document["steps"][name]["matrix"]
    return rows


def column(document: Table, name: str) -> int:
    return [c["name"] for c in document["coordinates"]].index(name)


def decay_more_slowly(document: Table, proof: Table) -> None:
    """The rate is 0.1 % larger than that of f1 on the edges."""
    document["decaying"]["rate"] *= 1.001


def hold_a_unit(document: Table, proof: Table) -> None:
    step(document, "period")[column(document, "f1")][column(document, "f1")] = 1


def grow_the_constant(document: Table, proof: Table) -> None:
    step(document, "period")[column(document, "f2")][column(document, "f2")] = 1.1


def move_a_unit(document: Table, proof: Table) -> None:
    step(document, "motor")[column(document, "f2")][0] = 1


def change_noise(document: Table, proof: Table) -> None:
    step(document, "act")[column(document, "load")][0] = 1


def move_noise(document: Table, proof: Table) -> None:
    step(document, "motor")[column(document, "load")][0] = 1


def last_shorter(document: Table, proof: Table) -> None:
    for edge in document["edges"]:
        edge["duration"] = 0.009


def run_backwards(document: Table, proof: Table) -> None:
    document["edges"][0]["jump"][1] = {"exp": "motor", "seconds": -0.005}


def keep_what_is_sent(document: Table, proof: Table) -> None:
    """A coordinate that no location has is not 0 after an edge."""
    step(document, "period")[column(document, "sent")][column(document, "sent")] = 1


def take_no_time(document: Table, proof: Table) -> None:
    kept = ["arrive", "tick", "act"]
    document["edges"][0] |= {"jump": kept, "duration": 0}


def let_time_pass(document: Table, proof: Table) -> None:
    document["locations"][0]["clock"] = 0.01


def limit_the_speed(document: Table, proof: Table) -> None:
    document["while"] = [{"output": "speed", "less": 1000}]


def read_an_input(document: Table, proof: Table) -> None:
    document["outputs"][0] = {"name": "speed", "unit": "", "input": 0, "in": ["0 lost"]}


def read_a_velocity(document: Table, proof: Table) -> None:
    document["outputs"][0]["velocity"] = document["outputs"][0]["rows"]


def miss_a_tick(document: Table, proof: Table) -> None:
    document["edges"][0]["jump"].remove("tick")


def delay_a_tick(document: Table, proof: Table) -> None:
    document["edges"][2]["jump"][1]["seconds"] = 0.002
    document["edges"][2]["duration"] = 0.007


def push_harder(document: Table, proof: Table) -> None:
    step(document, "motor")[1][column(document, "voltage")] *= 1.3


def widen_an_interval(document: Table, proof: Table) -> None:
    step(document, "motor")[1][column(document, "voltage")] = [900, 1100]


def load_more(document: Table, proof: Table) -> None:
    document["rows"]["largest load"][0] = [1.05 * v for v in document["rows"]["largest load"][0]]


def lose_more(document: Table, proof: Table) -> None:
    edge = copy.deepcopy(document["edges"][2])
    document["edges"].append(edge | {"name": "more", "from": "2 lost", "to": "2 lost"})


def start_higher(document: Table, proof: Table) -> None:
    document["start"]["columns"][0][0] *= 1.01


def shrink_the_constant_level(document: Table, proof: Table) -> None:
    proof["bounds"][0]["levels"][1] *= 0.98


def shrink_the_decaying_level(document: Table, proof: Table) -> None:
    """In a period f1 decays by 2 %, its square by 4 %."""
    proof["bounds"][0]["levels"][0] *= 0.95


def leave_out_the_factor(document: Table, proof: Table) -> None:
    del proof["bounds"][0]["factors"]


def enlarge_a_factor(document: Table, proof: Table) -> None:
    proof["bounds"][0]["factors"]["0 lost, early"] = 0.97


def negate_a_factor(document: Table, proof: Table) -> None:
    proof["bounds"][0]["factors"]["0 lost, early"] = -0.5


def be_of_another_edge(document: Table, proof: Table) -> None:
    proof["bounds"][0]["factors"]["3 lost, early"] = 1


def claim_a_limit(document: Table, proof: Table) -> None:
    """V would decay more slowly than it says."""
    proof["bounds"][0] |= {"from": "limit", "decay": 4.5}


def look_rarely(document: Table, proof: Table) -> None:
    proof["bounds"][0]["sub_step"] = 0.005


def never_look(document: Table, proof: Table) -> None:
    proof["bounds"][0]["sub_step"] = 0


def have_no_spread(document: Table, proof: Table) -> None:
    proof["bounds"][0]["spread"] = 0


def use_a_large_spread(document: Table, proof: Table) -> None:
    proof["bounds"][0]["spread"] = 0.1


def forget_noise_during_edges(document: Table, proof: Table) -> None:
    for name in [*proof["bounds"][0]["multipliers"]]:
        if name.startswith("during"):
            del proof["bounds"][0]["multipliers"][name]


def let_a_unit_become_0(document: Table, proof: Table) -> None:
    """Where f1 is 0, nothing is below it, and an edge whose facts need |x| ≥ f1 may be taken with x = 0."""
    step(document, "period")[column(document, "f1")][column(document, "f1")] = 0


def repeat_nothing(document: Table, proof: Table) -> None:
    """So often that it takes long."""
    document["edges"][0]["jump"].append({"repeat": [], "times": 10**12})


def multiply_a_unit_often(document: Table, proof: Table) -> None:
    """Its exact number would have millions of digits."""
    document["edges"][0]["jump"].append({"repeat": ["period"], "times": 90_000})


def visit_other_places(document: Table, proof: Table) -> None:
    """The start is not among them."""
    bound = proof["bounds"][0]
    del bound["forms"]["0 lost"]
    kept = {"1 lost, lost"}
    bound["factors"] = {k: v for k, v in bound["factors"].items() if k in kept}
    bound["only"] = ["1 lost", "2 lost"]


FAULTS: dict[Change, str] = {
    decay_more_slowly: "decays more slowly than at its rate",
    hold_a_unit: "decays more slowly than at its rate",
    grow_the_constant: "a unit or noise changes in period",
    move_a_unit: "a unit or noise changes in motor",
    change_noise: "a unit or noise changes in act",
    move_noise: "a unit or noise changes in motor",
    last_shorter: "the duration is not the sum of its steps",
    run_backwards: "a time below 0",
    keep_what_is_sent: "lacks is not 0 after it",
    take_no_time: "no time passes in a cycle",
    let_time_pass: "the clock is above 0",
    limit_the_speed: "has no limits",
    read_an_input: "where no time passes",
    read_a_velocity: "where no time passes",
    miss_a_tick: "not proven at edge/0 lost, early",
    delay_a_tick: "the duration is not the sum of its steps|not proven at",
    push_harder: "not proven at",
    widen_an_interval: "not proven at",
    load_more: "not proven at",
    lose_more: "the proof|not proven at edge/more",
    start_higher: "not proven at start",
    shrink_the_constant_level: "not proven at",
    shrink_the_decaying_level: "not proven at",
    leave_out_the_factor: "not proven at edge/",
    enlarge_a_factor: "not proven at edge/0 lost, early",
    negate_a_factor: "the factor of 0 lost, early is below 0",
    be_of_another_edge: "unknown key",
    claim_a_limit: "in the limit the factor",
    look_rarely: "not proven at during/",
    never_look: "not above 0",
    have_no_spread: "the spread is not above 0",
    use_a_large_spread: "not proven at during/",
    forget_noise_during_edges: "not proven at during/",
    let_a_unit_become_0: "or becomes 0",
    repeat_nothing: "at least one, at least once",
    multiply_a_unit_often: "a power has more than",
    visit_other_places: "no run starts",
}


@pytest.mark.parametrize("change", FAULTS, ids=lambda change: change.__name__)
def test_a_fault_is_rejected(change: Change) -> None:
    document, proof = copy.deepcopy(bounded())
    change(document, proof)
    with pytest.raises(RejectedError, match=FAULTS[change]):
        proven(document, proof)


def shrink_the_factor(document: Table, proof: Table) -> None:
    proof["growth"][1]["factor"] *= 0.98


def enlarge_the_cycles_factor(document: Table, proof: Table) -> None:
    proof["growth"][0]["factor"] *= 1.0001


def take_another_period(document: Table, proof: Table) -> None:
    proof["growth"][1]["period"] = 0.004


def take_no_period(document: Table, proof: Table) -> None:
    proof["growth"][1]["period"] = 0


def have_an_empty_form(document: Table, proof: Table) -> None:
    forms = proof["growth"][1]["forms"]
    forms["0 lost"] = [[0] * len(row) for row in forms["0 lost"]]


def have_a_negative_form(document: Table, proof: Table) -> None:
    forms = proof["growth"][1]["forms"]
    for name in forms:
        forms[name] = [[-v for v in row] for row in forms[name]]


def have_no_form(document: Table, proof: Table) -> None:
    del proof["growth"][1]["forms"]["0 lost"]


def have_forms_and_a_cycle(document: Table, proof: Table) -> None:
    proof["growth"][1]["cycle"] = proof["growth"][0]["cycle"]


def skip_an_edge(document: Table, proof: Table) -> None:
    cycle = proof["growth"][0]["cycle"]
    cycle.remove(next(name for name in cycle if name.endswith("lost, lost")))


def stop_early(document: Table, proof: Table) -> None:
    cycle = proof["growth"][0]["cycle"]
    del cycle[next(k for k, name in enumerate(cycle) if name.endswith("lost")) + 1 :]


def have_no_edge(document: Table, proof: Table) -> None:
    proof["growth"][0]["cycle"] = []


def need_a_fact(document: Table, proof: Table) -> None:
    """An edge of the cycle may be taken only if the speed is 0."""
    document["rows"]["speed"] = document["outputs"][0]["rows"]
    document["facts"]["rest"] = {"less": ["speed"], "more": [], "words": "at rest"}
    for edge in document["edges"]:
        edge["facts"] = ["rest"]


def be_out_of_reach(document: Table, proof: Table) -> None:
    document["locations"].append(document["locations"][0] | {"name": "before"})
    document["start"]["location"] = "before"
    proof["growth"].pop(1)


def be_out_of_reach_by_facts(document: Table, proof: Table) -> None:
    """No run is ever where the document's runs begin: f2 is not 0."""
    document["rows"]["f2"] = [[int(c["name"] == "f2") for c in document["coordinates"]]]
    document["facts"]["no"] = {"less": ["f2"], "more": [], "words": "never"}
    before = document["locations"][0] | {"name": "before", "facts": ["no"]}
    document["locations"].append(before)
    document["start"]["location"] = "before"
    document["edges"].append(document["edges"][0] | {"name": "begin", "from": "before"})
    proof["growth"].pop(1)


def be_left_to_chance(document: Table, proof: Table) -> None:
    """The difference of two runs does not vanish if they may differ in an entry."""
    step(document, "tick")[column(document, "integral")][column(document, "f2")] = [0, 1]


def take_a_tiny_period(document: Table, proof: Table) -> None:
    """The power of the factor would have millions of digits."""
    proof["growth"][1]["period"] = 0.00000001


def turn_the_sign(document: Table, proof: Table) -> None:
    entry = proof["growth"][0]
    if "sign" in entry:
        entry["sign"] = {"positive": "negative", "negative": "positive"}[entry["sign"]]
    else:
        entry["form"] = [[-v for v in row] for row in entry["form"]]


def leave_out_the_vector(document: Table, proof: Table) -> None:
    proof["growth"][0] |= {"sign": "either"}
    for key in ("form", "vector"):
        proof["growth"][0].pop(key, None)


FAULTS_OF_GROWTH: dict[Change, str] = {
    shrink_the_factor: "not proven of paths",
    enlarge_the_cycles_factor: "not proven to grow",
    take_another_period: "no multiple of the period",
    take_no_period: "not above 0",
    have_an_empty_form: "not positive definite",
    have_a_negative_form: "not positive definite",
    have_no_form: "no form in a cycle",
    have_forms_and_a_cycle: "either forms or a cycle",
    skip_an_edge: "does not follow",
    stop_early: "does not follow",
    have_no_edge: "in the cycle",
    need_a_fact: "has facts, or is not reached",
    be_out_of_reach: "has facts, or is not reached",
    be_out_of_reach_by_facts: "not reached from the start",
    be_left_to_chance: "a jump has an interval",
    take_a_tiny_period: "a power has more than",
    turn_the_sign: "not proven to grow",
    leave_out_the_vector: "positive or negative",
    miss_a_tick: "growth",
    push_harder: "growth",
}


@pytest.mark.parametrize("change", FAULTS_OF_GROWTH, ids=lambda change: change.__name__)
def test_a_fault_about_growth_is_rejected(change: Change) -> None:
    document, proof = copy.deepcopy(growing(6))
    change(document, proof)
    with pytest.raises(RejectedError, match=FAULTS_OF_GROWTH[change]):
        proven(document, proof)


def test_a_complex_pair_is_shown_by_a_form() -> None:
    """A rotation by 1 rad that grows by 1 % in a period of 1 s, and one that does not grow."""
    c, s = 1.01 * np.cos(1.0), 1.01 * np.sin(1.0)
    document = turning([[c, -s], [s, c]])
    search = GrowthSearch(PeriodGraph(document))
    assert search.cycle is not None
    entry = search.at_least(search.cycle, 1e-6)
    assert entry is not None
    assert "form" in entry
    _, (growth,) = proven(document, proof_of(growth=[entry]))
    assert float(growth.factor) == pytest.approx(1.01, rel=1e-5)
    with pytest.raises(RejectedError, match="not proven to grow"):
        proven(document, proof_of(growth=[entry | {"factor": 1.0101}]))
    with pytest.raises(RejectedError, match="not proven to grow"):
        proven(document, proof_of(growth=[entry | {"vector": [[0], [0]]}]))


def turning(rows: list[list[float]]) -> Table:
    """Return a document of two states x⁺ = rows x, once in a second."""
    names = ["a", "b"]
    still = [[0, 0], [0, 0]]
    return {
        "format": "noack-hybrid 1", "name": "turning",
        "coordinates": [{"name": name, "unit": ""} for name in names],
        "rows": {}, "facts": {}, "motions": {},
        "steps": {
            "turn": {"words": "x turns", "matrix": [[float(v) for v in row] for row in rows]},
            "wait": {"words": "nothing moves", "matrix": still},
        },
        "locations": [{"name": "on", "coordinates": names, "motion": None, "facts": []}],
        "edges": [{
            "name": "turn", "from": "on", "to": "on", "clock": "zero", "facts": [],
            "jump": ["turn", {"exp": "wait", "seconds": 1}], "duration": 1,
        }],
        "start": {"location": "on", "columns": [[1], [0]], "facts": []},
        "outputs": [{"name": "a", "unit": "", "rows": [[1, 0]], "in": ["on"]}],
    }  # fmt: skip


def test_a_bound_that_is_not_tested_during_edges_says_so() -> None:
    document = copy.deepcopy(bounded()[0])
    document["outputs"][0]["during_edges"] = False
    bound = BoundSearch(PeriodGraph(document)).bound("speed", 10.0)
    assert bound is not None
    (statement,), _ = proven(document, proof_of(bound))
    assert re.search(r" rad/s before and after each edge$", str(statement))


def test_a_flow_is_bounded_between_the_points_at_which_it_is_tested() -> None:
    """y is 0 at both ends of an edge, and near 1 between: (y, v) turns once, and decays a little."""
    w, names = 20 * np.pi, ["y", "v", "f2"]
    document = turning([[1, 0], [0, 1]]) | {
        "coordinates": [{"name": name, "unit": ""} for name in names],
        "constant": "f2",
        "steps": {"swing": {"words": "y swings", "matrix": [[-0.01, w, 0], [-w, -0.01, 0], [0, 0, 0]]}},
        "locations": [{"name": "on", "coordinates": names[:2], "motion": None, "facts": []}],
        "start": {"location": "on", "columns": [[0], [1], [1]], "facts": []},
        "outputs": [{"name": "y", "unit": "", "rows": [[1, 0, 0]], "in": ["on"], "during_edges": True}],
    }
    document["edges"][0] |= {"jump": [{"exp": "swing", "seconds": 0.1}], "duration": 0.1}

    def bound(level: float, sub_step: float) -> Table:
        return proof_of({
            "output": "y", "from": "start", "decay": 0, "levels": [0, level],
            "matrices": {"P": [[level * 0.999, 0], [0, level * 0.999]], "one": [[-level]]},
            "forms": {"on": {"nodes": [0], "terms": [[
                {"matrix": "P", "on": [0, 1], "times": 1}, {"matrix": "one", "on": [2], "times": 1},
            ]]}},
            "multipliers": {}, "factors": {"turn": 0.9999}, "sub_step": sub_step, "spread": 0.01,
        })  # fmt: skip

    (statement,), _ = proven(document, bound(1.1, 0.001))
    assert str(statement) == "|y| ≤ 1.04881 at all times"
    for level, sub_step in ((1.1, 0.1), (1.1, 0.05), (1.1, 0.03), (0.9, 0.001)):
        with pytest.raises(RejectedError, match=r"not proven at during/turn|not proven at output/on"):
            proven(document, bound(level, sub_step))


@pytest.mark.parametrize("times", [1, 2, 4])
def test_a_step_that_is_repeated_has_another_matrix_of_its_interval_each_time(times: int) -> None:
    """x := −x + b with |b| ≤ 1: twice the same b leave x as it is, but b may be 1 and then −1."""
    document = turning([[1, 0], [0, 1]]) | {
        "coordinates": [{"name": "x", "unit": ""}, {"name": "f2", "unit": ""}],
        "constant": "f2",
        "steps": {
            "push": {"words": "x is turned and pushed", "matrix": [[-1, [-1, 1]], [0, 1]]},
            "wait": {"words": "nothing moves", "matrix": [[0, 0], [0, 0]]},
        },
        "locations": [{"name": "on", "coordinates": ["x"], "motion": None, "facts": []}],
        "start": {"location": "on", "columns": [[1], [1]], "facts": []},
        "outputs": [{"name": "x", "unit": "", "rows": [[1, 0]], "in": ["on"]}],
    }
    wait = {"exp": "wait", "seconds": 1}
    bound = proof_of({
        "output": "x", "from": "start", "decay": 0, "levels": [0, 1],
        "matrices": {"P": [[1, 0], [0, -1]]},
        "forms": {"on": {"nodes": [0], "terms": [[{"matrix": "P", "on": [0, 1], "times": 1}]]}},
        "multipliers": {},
    })  # fmt: skip
    document["edges"][0]["jump"] = [wait]
    assert proven(document, bound)[0]
    document["edges"][0]["jump"] = [{"repeat": ["push"], "times": times}, wait]
    with pytest.raises(RejectedError, match="not proven at edge/turn"):
        proven(document, bound)
