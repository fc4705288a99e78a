"""The search for witnesses: which ν it tries, what it minimises, how far it is, and when it ends."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import fmpq

from cosim.analysis.certificates import Certificates
from cosim.analysis.witnesses import resolved_content
from noack.core.balls import identity, matrix, number
from noack.core.progress import no_progress
from noack.proof import semidefinite
from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.scenario import read_loop
from noack.proof.search.results import read_assumptions
from noack.proof.semidefinite import Accuracy
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import load
from noack.theory.witnesses.assumptions import first_assumptions, without_drift
from noack.theory.witnesses.coordinates import floats, simulated_frames
from noack.theory.witnesses.documents import _by_forms, _Rates, _Wanted, find_witness, rough_bounds
from noack.theory.witnesses.effort import Effort, NoWitnessError, TooLargeError, WorkLimitError
from noack.theory.witnesses.line_search import search_lowest
from noack.theory.witnesses.problem_size import problem_sizes, require_small
from noack.theory.witnesses.search import Search
from noack.theory.witnesses.templates import Templates
from tests.checker.loops import SCHEDULE, bounds_of, double_integrator, pushed, scalar
from tests.checker.proofs import proved
from tests.checker.random_loops import long_run_s, random_loop
from tests.checker.runs import exceeded
from tests.helpers.shipped import resolved

CASES = Path(__file__).parents[1] / "cases"


@pytest.mark.parametrize("lowest", [0.15, 0.42, 0.6, 0.85])
def test_the_lowest_value_is_found_with_few_values(lowest: float) -> None:
    values: dict[float, float] = {}

    def value(share: float) -> float:
        assert share not in values
        values[share] = math.exp(math.log(share / lowest) ** 2) if share > 0.08 else math.inf
        return values[share]

    search_lowest(value, 0.42, 5, upwards=True)
    assert len(values) <= 6
    assert all(0 < share < 1 for share in values)
    assert min(values.values()) < 1.05


@pytest.mark.deep
def test_a_loop_that_starts_at_rest_is_bounded() -> None:
    """Nothing drives it: bounds of its drift are 0, and have no logarithm."""
    certificates = Certificates(resolved(
        "unstable_pendulum", "model={A=[[0.0, 1.0], [-2.0, -1.0]], B=[[0.0], [1.0]], gain=[[-1.0, -1.0]]}",
        "plant={initial_state=[0.0, 0.0]}", 'outputs=[{name="x_1", allowed=0.05}]', "network.mansd=2",
        "trigger={beta=0.05, alpha_per_s=0.3, floor=0.005}",
    ))  # fmt: skip
    certificates.prove(conditions=("schedule",))
    (bound,) = certificates.output_bounds(certificates.schedule)
    assert bound.settles_s == 0


@pytest.mark.parametrize("size", [1e-300, 1e300])
def test_states_of_any_size_have_bounds_without_a_warning(size: float) -> None:
    """Squares of them overflow in the search."""
    loop = scalar(1, SCHEDULE, level=0.05 * size)._replace(start=number(size) * identity(1))
    assert 1 < bounds_of(find_witness(loop, ("x",)).proof)["x"] / size < 20


def test_without_a_finite_value_the_search_ends() -> None:
    tried: list[float] = []

    def value(share: float) -> float:
        tried.append(share)
        return math.inf

    search_lowest(value, 0.42, 5, upwards=True)
    assert len(tried) == 5


@pytest.mark.parametrize("decay", [0.7, 1.3])
def test_templates_are_the_inequalities_of_the_model(decay: float) -> None:
    loop = double_integrator()._replace(half_B=matrix([[0.0], [0.02]]))

    def model(decay: float) -> Model:
        return Model(loop, number(0.3), number(decay), later=1, later_at_start=1, is_exact=False)

    rng, matrices = np.random.default_rng(0), {}
    items = list(model(decay).inequalities("drift", starts=True))
    found = Templates(model).at(decay, "drift", starts=True)
    for item, template in zip(items, found, strict=True):
        exact, own = floats(item.constant), template.constant
        for name, left, right in item.parts:
            n = left.nrows()
            V = matrices.setdefault(name, (M := rng.normal(size=(n, n))) + M.T)
            product = floats(left).T @ V @ floats(right)
            exact = exact + product + product.T
        for name, left_float, right_float in template.parts:
            product = left_float.T @ matrices[name] @ right_float
            own = own + product + product.T
        assert own == pytest.approx(exact, abs=1e-9)
        for (name, M), (other, M_float) in zip(item.scalars, template.scalars, strict=True):
            assert (name, M_float) == (other, pytest.approx(floats(M), abs=1e-12))


def test_the_rate_of_a_similar_loop_needs_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """With ν from ideal conditions each output needs one problem, and its bound is nearly as small."""
    ideal, alone = proved("ideal").document, proved("double_integrator")
    solved = []
    solve = semidefinite._Problem.solve

    def counted(*arguments: object) -> semidefinite.SolverAnswer:
        solved.append(arguments)
        return solve(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(semidefinite._Problem, "solve", counted)
    helped = bounds_of(find_witness(alone.loop, near=[ideal]).proof)
    assert len(solved) <= 5
    for output, bound in bounds_of(alone.proof).items():
        assert helped[output] < 1.03 * bound


def test_a_rate_of_a_similar_loop_with_which_nothing_is_found_is_left() -> None:
    """ν is from 0.5 to 2: 1.99 is too large here. The second loop has another r, the last one has no ν."""
    loop = scalar(1, SCHEDULE, level=0.05)
    alone = find_witness(loop, ())
    for rate, decay in ((0.25, 1.99), (0.1, 0.8)):
        bound = {"output": "drift", "from_start": True, "decay": decay}
        near = {"rate": rate, "bounds": [bound]}
        assert bounds_of(find_witness(loop, (), near=[near]).proof) == bounds_of(alone.proof)
    by_gains = {"rate": 0.25, "gains": {}}
    rough = [rough_bounds(loop, ["x"], near, Effort(no_progress)).sizes for near in ([], [by_gains])]
    assert rough[0] == rough[1]


def test_no_bound_of_a_periodic_rule_decays_faster_than_that_of_a_similar_loop() -> None:
    loop, rate = proved("random_periodic_11").loop, proved("random_periodic_11").document["rate"]
    slower = find_witness(loop, ("x",), near=[{"rate": 0.9 * rate, "bounds": []}]).document
    assert slower["rate"] == pytest.approx(rate * 0.02 / 0.3)


def test_a_loop_is_searched_although_a_similar_one_decays_more_slowly() -> None:
    """So with the box of a plant: the rates that are tried are those of the box's centre."""
    near = {"rate": 0.001, "bounds": []}
    loop = proved("random_periodic_11").loop
    assert find_witness(loop, ("x",), near=[near]).document["rate"] == 0.001


def uncertain(half_width: float) -> Loop:
    return scalar(1, SCHEDULE, level=0.05)._replace(half_B=number(half_width) * identity(1))


def test_a_small_rate_is_tried_where_larger_ones_have_no_forms() -> None:
    found = find_witness(uncertain(0.6), ("x",))
    assert "bounds" in found.document
    assert bounds_of(found.proof)["x"] < 2


def test_a_search_without_forms_says_which_inequality_fails_first_and_by_how_much() -> None:
    too_uncertain = r"no quadratic forms \(first fails flow/0 later/0/0, by 6\.\d V\)"
    with pytest.raises(NoWitnessError, match=too_uncertain):
        find_witness(uncertain(0.8), ("x",))


def test_inequalities_that_have_a_solution_are_not_missed() -> None:
    loop = double_integrator()
    document = {**first_assumptions(loop, 0.3), "rate": 0.3}
    assumed = read_assumptions(loop, number(0.3), document)

    def model(decay: float) -> Model:
        return Model(loop, number(0.3), number(decay), assumed.errors, **assumed.of_model, is_exact=False)

    templates = Templates(model)
    search, accuracy = (
        Search(templates, simulated_frames(templates.model)),
        Accuracy(1e-3, 1e-3, improves_steps=False),
    )
    possible = search.shortfall("x", 0.8, starts=True, accuracy=accuracy)
    assert possible is not None
    assert possible.share < 1e-3
    impossible = search.shortfall("x", 20.0, starts=True, accuracy=accuracy)
    assert impossible is not None
    assert impossible.share > 1
    assert impossible.name.startswith("flow/")


def test_a_loop_that_does_not_decay_has_no_witness() -> None:
    loop = double_integrator()
    with pytest.raises(NoWitnessError, match="does not decay"):
        find_witness(loop._replace(gain=loop.gain * -1))


def test_the_size_of_a_problem_is_known_before_its_inequalities() -> None:
    rng = np.random.default_rng(0)
    for kind in ("threshold", "periodic", "noisy"):
        loop = random_loop(rng, kind)
        rate = _Rates(loop).rate
        document = without_drift(loop, first_assumptions(loop, rate))
        if loop.times.period > 0:
            document["pieces"] = 4
        assumed = read_assumptions(loop, number(rate), document)
        known = assumed.errors, assumed.noise

        def model(decay: float, *of: Any, loop: Loop = loop, rate: float = rate, **more: Any) -> Model:
            return Model(loop, number(rate), number(decay), *of, **more, is_exact=False)

        templates = Templates(lambda decay: model(decay, *known, **assumed.of_model))  # noqa: B023
        sizes = sorted(len(item.constant) for item in templates.at(1.0, "x", starts=False))
        assert sizes == sorted(problem_sizes(templates.model))


def test_a_loop_that_is_too_large_is_refused_at_once_with_what_is_small_enough() -> None:
    """A speed loop whose updates act after 37 ms, three of them on their way, with a period of 10 ms."""
    loop = read_loop(resolved_content(resolve(load(CASES / "drive_tie.toml"))), box=False, ideal=False)
    effort = Effort(lambda share: pytest.fail("a problem was solved"))
    with pytest.raises(TooLargeError) as refused:
        _by_forms(loop, _Wanted(("x",), (), ()), effort)
    assert str(refused.value) == (
        "the loop's inequalities are too large for the search, by a factor of 1.5; small enough: updates "
        "that act within 30 ms of their event, 37 ms now"
    )
    short = loop._replace(times=loop.times._replace(delay=fmpq(30, 1000)))
    document = {**first_assumptions(short, 0.1), "pieces": 16}
    require_small(short, number(0.1), document, effort.most_per_problem)


@pytest.mark.parametrize(("kind", "seed", "output"), [("threshold", 105, "e_c"), ("periodic", 11, "x")])
def test_runs_stay_within_what_is_found_anew(kind: str, seed: int, output: str) -> None:
    """A stored proof is true whatever the model leaves out; one that is found by such a model is not."""
    rng = np.random.default_rng(seed)
    loop = random_loop(rng, kind)
    proof = find_witness(loop, (output,)).proof
    for _ in range(4):
        assert exceeded(loop, proof, rng, long_run_s(loop) / 2) == []


def test_progress_rises_to_its_end() -> None:
    shares: list[float] = []
    find_witness(scalar(times=SCHEDULE), progress=shares.append)
    assert len(shares) > 8
    assert shares == sorted(shares)
    assert 0 < shares[0] < 0.2 < shares[-1] < 1


def test_a_search_ends_at_its_limit_of_work() -> None:
    found = find_witness(scalar(times=SCHEDULE), most_work=1e-9).document
    assert "bounds" not in found
    assert "gains" in found
    mixed = double_integrator().rule._replace(positive=matrix([[1, 0, 1, 0], [0, 0, 0, 1]]))
    with pytest.raises(WorkLimitError, match="the search ended after 0 problems"):
        find_witness(double_integrator()._replace(rule=mixed), most_work=1e-9)
    effort = Effort(lambda share: None, 2.5)
    effort.add("x", 1.0)
    effort.add("x", 1.0)
    with pytest.raises(WorkLimitError, match="x: the search ended after 2 problems"):
        effort.add("x", 1.0)


def test_both_parts_of_a_bound_count_in_units_of_their_thresholds() -> None:
    """Of 0.05 and 0.0005. In one unit the second part counts for nothing, and is 31 of its thresholds.

    So a disturbance shortens the time between events as little as possible.
    """
    loop = pushed(double_integrator(floor=0.0005), 0.0005)
    proof = find_witness(loop, ("e_c",)).proof
    by_forms = next(bound for bound in proof.bounds if bound.output == "e_c")
    assert by_forms.decaying < 10 * 0.05
    assert by_forms.constant < 10 * 0.0005
    assert proof.inter_event is not None
    assert float(proof.inter_event) > 0.02
    assert exceeded(loop, proof, np.random.default_rng(0), 6.0) == []


def test_steps_are_improved_where_rounding_errors_end_the_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    solve, improved = semidefinite._Problem.solve, []

    def first_fails(
        self: semidefinite._Problem,
        objective: Mapping[str, float],
        free: set[str],
        accuracy: Accuracy,
    ) -> semidefinite.SolverAnswer:
        improved.append(accuracy.improves_steps)
        answer = solve(self, objective, free, accuracy)
        return answer if accuracy.improves_steps else answer._replace(status="NumericalError")

    monkeypatch.setattr(semidefinite._Problem, "solve", first_fails)
    one = semidefinite.MatrixInequality((), (("level 1", np.eye(1)),), -np.eye(1))
    accuracy = Accuracy(gap=1e-6, feasibility=1e-6, improves_steps=False)
    answer = semidefinite.minimise({"level 1": 1.0}, [one], margin=0.0, accuracy=accuracy)
    assert answer.is_solved
    assert answer.numbers["level 1"] == pytest.approx(1, rel=1e-3)
    assert improved == [False, True]


def test_with_many_events_while_an_update_is_on_its_way_there_is_no_witness() -> None:
    loop = double_integrator()
    slow = loop._replace(times=loop.times._replace(delay=fmpq(1)), half_B=matrix([[0.0], [0.9]]))
    with pytest.raises(NoWitnessError, match=r"forms .+; gains: what losses and delays add"):
        find_witness(slow)
