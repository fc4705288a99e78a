"""The growth of time-triggered loops: what noack-check accepts is true, and false witnesses are rejected."""

import copy
from collections.abc import Mapping, Sequence
from itertools import product
from math import lcm
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cosim.analysis.witnesses import resolved_content
from netem.core.errors import CallerError
from netem.guarantee.loss_guarantee import LongestBurst, LossesInWindow, LossGuarantee
from noack.core.linear_systems import Matrix
from noack.proof.elaborate.errors import RejectedError
from noack.proof.search.growth import PeriodicLoop, prove_growth
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.theory.time_triggered.time_triggered_loop import TimeTriggeredLoop
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.growth import enclose_growth
from noack.theory.witnesses.loss_margin import LossMargin
from noack_kernel.__main__ import verify
from tests.helpers.command_line import invoke
from tests.helpers.shipped import shipped

pytestmark = pytest.mark.usefixtures("nothing_was_found_before")

PERIODIC = "trigger={policy='periodic', period_s=0.1}"
LONGEST = 6
"""Of the patterns that are played."""


def delayed(delay_s: float) -> str:
    return f"network.impairments=[{{kind='delay', delay_s={delay_s}}}]"


def within(losses: int, window: int) -> tuple[str, str]:
    limit = f"{{kind='at_most', losses={losses}, window={window}}}"
    return "network.mansd=9", f"network.constraints=[{limit}]"


def scenario(name: str, *settings: str) -> Scenario:
    return resolve(shipped(name, *settings))


def periodic(name: str, *settings: str) -> PeriodicLoop:
    return LossMargin(scenario(name, *settings)).bursts_loop


def loop_from(content: Mapping[str, object]) -> PeriodicLoop:
    """Return the loop of a resolved scenario's tables."""
    return LossMargin(resolve(validate(content, "changed"))).bursts_loop


def test_a_set_point_does_not_change_the_growth() -> None:
    """Of any form: as a scenario states it, and as a resolved one has it."""
    resolved = scenario("lane_periodic", "controller.setpoint=[0.0, 0.0, 0.0, 3.5]")
    at_rest = matrices(periodic("lane_periodic"))
    for content in (resolved.content(), resolved_content(resolved)):
        np.testing.assert_array_equal(matrices(loop_from(content)), at_rest)
    words = ("margin", "double_integrator", "--set", PERIODIC, "--no-period", "--most", "2")
    moved = invoke(*words, "--set", "controller.setpoint=[2, 0]")
    assert moved.stdout == invoke(*words).stdout


def matrices(loop: PeriodicLoop) -> tuple[list[Matrix], list[Matrix]]:
    """The matrices of a unit with and without an arrival, by slot, from the scenario's times alone."""
    A, B, K, H = map(floats, loop.matrices)
    exact, slots = TimeTriggeredLoop(A, B, K, H, loop.times), range(loop.times.slots)
    delivered, lost = ([exact.period(slot, fate).middle for slot in slots] for fate in (True, False))
    return delivered, lost


def worst_growth(loop: PeriodicLoop) -> tuple[float, str]:
    """Return the growth per period of the worst short pattern, by products in floating point."""
    maps = dict(zip("DL", matrices(loop), strict=True))
    worst, slots = (0.0, ""), loop.times.slots
    for length in range(1, LONGEST + 1):
        for letters in product("DL", repeat=length):
            pattern = "".join(letters)
            if pattern[0] == "L" or not allows(loop, pattern * (2 + LONGEST)):
                continue
            periods = lcm(length, slots)
            Π = np.eye(len(maps["D"][0]))
            for k in range(periods):
                Π = maps[pattern[k % length]][k % slots] @ Π
            worst = max(worst, (float(np.abs(np.linalg.eigvals(Π)).max() ** (1 / periods)), pattern))
    return worst


def allows(loop: PeriodicLoop, outcomes: str) -> bool:
    """Whether no part of the outcomes has too many losses, from what the rules say."""
    return all(
        outcomes[begin : begin + window].count("L") <= most
        for most, window in loop.guarantee.windows
        for begin in range(len(outcomes))
    )


def accepted(loop: PeriodicLoop) -> tuple[dict[str, object], float]:
    """Return a witness of what is found of a loop, and its bound per period."""
    growth, _ = worst_growth(loop)
    found = enclose_growth(loop, 1e-2)
    assert found.stable is not None
    assert found.unstable is not None
    assert growth * (1 - 1e-5) <= found.lower
    assert growth <= found.upper <= found.lower * (1 + 1.1e-2)
    if found.lower >= 1:
        return copy.deepcopy(found.unstable), found.lower
    return copy.deepcopy(found.stable), found.upper


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("lane_periodic", ()),
        ("lane_periodic", ("network.mansd=6",)),
        ("lane_periodic", ("mode=zoh",)),
        ("lane_periodic", within(3, 5)),
        ("double_integrator", (PERIODIC, "controller.rate_hz=16", delayed(0.07))),
        ("double_integrator", (PERIODIC, delayed(0.25))),
        ("unstable_pendulum", ("trigger={policy='periodic', period_s=0.05}",)),
    ],
)
def test_a_witness_is_found_and_proves_what_short_patterns_do(name: str, settings: Sequence[str]) -> None:
    document, bound = accepted(periodic(name, *settings))
    assert ("stable" in document) == (bound < 1)


SMALL = ("double_integrator", PERIODIC, "controller.rate_hz=40", delayed(0.13), "network.mansd=3")


def changed_scenario(content: Mapping[str, object], rng: np.random.Generator) -> dict[str, object]:
    """Return a resolved scenario with one change: of a matrix, the period, the delay or the phase."""
    changed = copy.deepcopy(dict(content))
    model, plant, trigger, network, controller = (
        changed[key] for key in ("model", "plant", "trigger", "network", "controller")
    )
    kind = rng.integers(0, 6)
    if kind == 0:
        model["gain"][0][rng.integers(2)] *= 1 + 0.2 * rng.normal()
    elif kind == 1:
        plant["A"][1][rng.integers(2)] += 0.1 * rng.normal()
    elif kind == 2:
        trigger["period_s"] = float(rng.choice([0.05, 0.12, 0.2, 0.3]))
    elif kind == 3:
        delay_s = float(rng.choice([0.0, 0.05, 0.2, 0.33]))
        network["impairments"][0]["delay_s"] = changed["certificate"]["network_delay_s"] = delay_s
    elif kind == 4:
        plant["B"][1][0] *= 1 + 0.2 * rng.normal()
    else:
        controller["phase"] = float(rng.choice([0.0, 0.25, 0.9]))
    return changed


def changed_document(document: Mapping[str, object], rng: np.random.Generator) -> dict[str, object]:
    """Return a witness with one change: of its factor, losses, memory, or one entry of a form."""
    changed = copy.deepcopy(dict(document))
    stable = changed["stable"]
    forms, kind = stable["forms"], rng.integers(0, 5)
    if kind == 0:
        stable["factor"] *= float(rng.choice([0.9, 0.95, 0.98, 1.05]))
    elif kind == 1:
        changed["losses"] += int(rng.choice([-1, 1, 2]))
    elif kind == 2:
        stable["memory"] = 1
        forms[:] = [forms[0] for _ in range(int(rng.choice([1, 2, 4, 16])))]
    elif kind == 3:
        first, other = rng.integers(0, len(forms), 2)
        forms[first], forms[other] = forms[other], forms[first]
    else:
        P = forms[rng.integers(0, len(forms))]
        i, j = rng.integers(0, len(P), 2)
        P[i][j] = P[j][i] = P[i][j] * (1 + 0.3 * rng.normal())
    return changed


@pytest.mark.parametrize(
    ("seed", "count"), [(0, 12), *(pytest.param(seed, 24, marks=pytest.mark.deep) for seed in range(9))]
)
def test_what_is_accepted_of_changed_witnesses_is_true(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    resolved = scenario(*SMALL)
    content = resolved_content(resolved)
    loop = loop_from(content)
    document, _ = accepted(loop)
    rejected = 0
    for number in range(count):
        is_scenario = number % 2 == 0
        other_loop = loop_from(changed_scenario(content, rng)) if is_scenario else loop
        other = document if is_scenario else changed_document(document, rng)
        try:
            what = prove_growth(other_loop, other)
        except RejectedError:
            rejected += 1
            continue
        assert what.upper is not None
        checked = other_loop.under(other_loop.guarantee.capped(what.losses))
        assert worst_growth(checked)[0] <= float(what.upper)
    assert count // 6 < rejected < count


UNSTABLE = ("lane_periodic", "mode=zoh", delayed(0.01))


def growth_of(loop: PeriodicLoop, pattern: str) -> float:
    """Return the growth per period of a pattern that is repeated, from any slot the least, in floats."""
    maps, slots = dict(zip("DL", matrices(loop), strict=True)), loop.times.slots
    periods, found = lcm(len(pattern), slots), []
    for first in range(slots):
        Π = np.eye(len(maps["D"][0]))
        for k in range(periods):
            Π = maps[pattern[k % len(pattern)]][(first + k) % slots] @ Π
        found.append(float(np.abs(np.linalg.eigvals(Π)).max() ** (1 / periods)))
    return min(found)


def changed_pattern(document: Mapping[str, object], rng: np.random.Generator) -> dict[str, object]:
    """Return a witness of a growing pattern with one change."""
    changed = copy.deepcopy(dict(document))
    table = changed["unstable"]
    kind, pattern = rng.integers(0, 7), list(table["pattern"])
    if kind == 0:
        k = rng.integers(len(pattern))
        pattern[k] = "L" if pattern[k] == "D" else "D"
    elif kind == 1:
        pattern.insert(rng.integers(len(pattern) + 1), rng.choice(["D", "L"]))
    elif kind == 2:
        del pattern[rng.integers(len(pattern))]
    elif kind == 3:
        table["squarings"] = int(rng.choice([-1, 0, 1, 3, 10, 39, 41, 10**6]))
    elif kind == 4:
        changed["losses"] += int(rng.choice([-2, -1, 1]))
    elif kind == 5:
        row = table["coordinates"][rng.integers(len(table["coordinates"]))]
        row[rng.integers(len(row))] *= float(rng.choice([-1.0, 0.0, 0.9, 1.1, 30.0]))
    else:
        table["intervals"] = [int(rng.choice([1, 1, 1, 2])) for _ in pattern]
    table["pattern"] = "".join(pattern)
    return changed


@pytest.mark.parametrize("count", [70, pytest.param(210, marks=pytest.mark.deep)])
def test_what_is_accepted_of_changed_patterns_grows(count: int) -> None:
    rng = np.random.default_rng(5)
    content = resolved_content(scenario(*UNSTABLE))
    loop = loop_from(content)
    document, bound = accepted(loop)
    assert bound > 1.5
    document["unstable"].setdefault("coordinates", np.eye(loop.size).tolist())  # type: ignore[attr-defined]
    found = []
    for number in range(count):
        is_scenario = number % 5 == 0
        other_loop = loop_from(changed_scenario(content, rng)) if is_scenario else loop
        other = document if is_scenario else changed_pattern(document, rng)
        try:
            what = prove_growth(other_loop, other)
        except RejectedError:
            continue
        assert what.lower is not None
        checked = other_loop.under(other_loop.guarantee.capped(what.losses))
        assert allows(checked, what.pattern * 3)
        assert float(what.lower) <= growth_of(checked, what.pattern) * (1 + 1e-9)
        found.append(float(what.lower))
    assert 0.19 * count < len(found) < 0.77 * count
    assert min(found) < 1 < max(found)


@pytest.mark.parametrize("settings", [("double_integrator", PERIODIC), UNSTABLE])
def test_what_is_accepted_of_other_windows_is_true(settings: Sequence[str]) -> None:
    """A guarantee allows so many losses in so many successive updates; with others it is another loop."""
    given = periodic(*settings, *within(2, 5))
    document, proven, rejected = accepted(given)[0], 0, 0
    for number, (most, window) in enumerate(product(range(5), range(1, 8))):
        loop = given.under(LossGuarantee((LongestBurst(9), LossesInWindow(most, window))))
        losses = min(most, 2 + number % 2) if most < window else 2 + number % 2
        try:
            what = prove_growth(loop, with_forms_for(loop, {**document, "losses": losses}))
        except RejectedError:
            rejected += 1
            continue
        proven += 1
        checked = loop.under(loop.guarantee.capped(losses))
        if what.upper is not None:
            assert worst_growth(checked)[0] <= float(what.upper)
        else:
            assert what.lower is not None
            assert allows(checked, what.pattern * (2 + window))
            assert float(what.lower) <= growth_of(checked, what.pattern) * (1 + 1e-9)
    assert min(proven, rejected) > 8


def with_forms_for(loop: PeriodicLoop, document: dict[str, Any]) -> dict[str, object]:
    """Return a document with as many forms as a loop needs: an inequality decides, not their number."""
    if "stable" not in document:
        return document
    checked, table = loop.under(loop.guarantee.capped(document["losses"])), document["stable"]
    nodes = {burst.source for burst in checked.bursts}
    forms = [table["forms"][node % len(table["forms"])] for node in range(len(nodes))]
    return {**document, "stable": table | {"forms": forms}}


def stable() -> tuple[PeriodicLoop, dict[str, object]]:
    loop = periodic(*SMALL)
    return loop, accepted(loop)[0]


def test_each_false_witness_is_rejected_with_its_reason() -> None:
    loop, document = stable()
    table = document["stable"]
    assert isinstance(table, dict)

    def rejects(reason: str, **changes: object) -> None:
        with pytest.raises(RejectedError, match=reason):
            prove_growth(loop, {**document, **changes})

    forms, size, count = table["forms"], loop.size, len(table["forms"])
    rejects("not one matrix for each", stable={**table, "forms": forms[:-1]})
    rejects("not one matrix for each", stable={**table, "memory": 1})
    rejects("memory: not a whole number", stable={**table, "memory": -1})
    rejects("memory: more than 5,000 transitions", stable={**table, "memory": 8}, losses=5)
    rejects("not above 0", stable={**table, "factor": 0.0})
    rejects("the inequality fails", stable={**table, "factor": 0.9 * table["factor"]})
    rejects("the inequality fails", losses=9)
    rejects("not positive definite", stable={**table, "forms": [np.zeros((size, size)).tolist()] * count})
    rejects("not positive definite", stable={**table, "forms": [np.ones((size, size)).tolist()] * count})
    rejects("not a square matrix of the right size", stable={**table, "forms": [[[1.0]]] * count})
    with pytest.raises(RejectedError, match="neither stable nor unstable"):
        prove_growth(loop, {"losses": 3})
    for pattern, reason in (
        ("LLLL", "does not allow it"),
        ("DLLLL", "does not allow it"),
        ("LD", "does not begin with a delivery"),
        ("DX", "not of letters"),
    ):
        with pytest.raises(RejectedError, match=reason):
            prove_growth(loop, {"losses": 3, "unstable": {"pattern": pattern, "squarings": 3}})
    for intervals in ([1], [1, 2], [1, True], "11"):
        table = {"pattern": "DL", "squarings": 3, "intervals": intervals}
        with pytest.raises(RejectedError, match="unstable: intervals"):
            prove_growth(loop, {"losses": 3, "unstable": table})


def test_a_decaying_pattern_is_not_called_unstable() -> None:
    loop, _ = stable()
    growth, pattern = worst_growth(loop)
    what = prove_growth(loop, {"losses": 3, "unstable": {"pattern": pattern, "squarings": 20}})
    assert what.lower is not None
    assert float(what.lower) == pytest.approx(growth, rel=1e-6)
    assert not what.lower > 1


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        (("trigger={policy='absolute', delta=0.1}",), "needs a longest time"),
        (
            (PERIODIC, "network.impairments=[{kind='delay', delay_s=0.01, jitter_s=0.005}]"),
            "needs a constant delay",
        ),
        ((PERIODIC, "plant.rate_hz=50", "controller.rate_hz=49.99"), "repeat only after too many steps"),
        ((PERIODIC, "controller.update_timeout_s=1", delayed(0.2)), "update_timeout_s: not covered with"),
        (
            (PERIODIC, "plant.disturbances=[{kind='uniform', bound=[0.1]}]"),
            "the plant is disturbed",
        ),
        (
            (PERIODIC, "plant.measurement.noise_bound=[0.1, 0.1]"),
            "is measured with noise",
        ),
    ],
)
def test_what_is_not_covered_is_refused(settings: Sequence[str], reason: str) -> None:
    with pytest.raises(CallerError, match=reason):
        periodic("double_integrator", *settings)


def test_an_observer_that_learns_nothing_is_not_called_stable() -> None:
    """x̂ = 0 and u = 0 at all times, while x grows."""
    plant = ("plant.draw=given", "plant.A=[[0.0, 1.0], [0.0, 0.0]]", "plant.B=[[0.0], [1.0]]")
    resolved = scenario("double_integrator", *plant, PERIODIC)
    content = resolved_content(resolved)
    content["observer"] = {"kind": "luenberger", "gain": [[0.0, 0.0]] * 2, "initial_estimate": [0.0, 0.0]}
    with pytest.raises(CallerError, match="observer"):
        loop_from(content)


def test_the_command_writes_what_noack_check_proves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [tmp_path / name for name in ("document.json", "proof.json")]
    words = ("unstable_pendulum", "--set", PERIODIC, "--set", "mode=zoh", "--no-period")
    result = invoke("margin", *words, "--document", str(files[0]), "--proof", str(files[1]))
    assert result.stdout.count("proved by noack-check: with") == 2
    assert verify(*files) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("PROVED")]
    assert len(lines) == 2
    assert lines[0].endswith(": stable")
    assert lines[1].endswith(": unstable")
