"""The growth of time-triggered loops: what noack-check accepts is true, and false witnesses are rejected."""

import copy
import json
from collections.abc import Mapping, Sequence
from itertools import product
from math import lcm
from pathlib import Path

import numpy as np
import pytest

from cosim.analysis.witnesses import resolved_content
from noack.core.linear_systems import Matrix
from noack.scenario.resolution import loop_of, resolve
from noack.scenario.scenario import Scenario
from noack.theory.margins.scenario_times import loop_times
from noack.theory.margins.time_triggered_loop import TimeTriggeredLoop
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.effort import NoWitnessError
from noack.theory.witnesses.growth import stable_document, unstable_document
from noack_check.__main__ import check_file
from noack_check.check import RejectedError
from noack_check.growth import PeriodicLoop, prove_growth, read_periodic_loop
from noack_check.keys import RefusedError
from tests.helpers.command_line import invoke
from tests.helpers.shipped import shipped

PERIODIC = "trigger={policy='periodic', period_s=0.1}"
LONGEST = 9
"""Of the patterns that are played."""


def delayed(delay_s: float) -> str:
    return f"network.impairments=[{{kind='delay', delay_s={delay_s}}}]"


def scenario(name: str, *settings: str) -> Scenario:
    return resolve(shipped(name, *settings))


def periodic(name: str, *settings: str) -> PeriodicLoop:
    resolved = scenario(name, *settings)
    return read_periodic_loop(resolved_content(resolved, resolved.certificate.late_periods))


def worst_growth(loop: PeriodicLoop) -> tuple[float, str]:
    """Return the growth per period of the worst short pattern, by products in floating point."""
    maps = {"D": [floats(M) for M in loop.delivered], "L": [floats(M) for M in loop.lost]}
    worst, slots = (0.0, ""), len(loop.lost)
    for length in range(1, LONGEST + 1):
        for letters in product("DL", repeat=length):
            pattern = "".join(letters)
            history = pattern * (2 + LONGEST)
            if any(letter == "L" and not loop.allows_loss(history[:k]) for k, letter in enumerate(history)):
                continue
            periods = lcm(length, slots)
            Π = np.eye(len(maps["D"][0]))
            for k in range(periods):
                Π = maps[pattern[k % length]][k % slots] @ Π
            worst = max(worst, (float(np.abs(np.linalg.eigvals(Π)).max() ** (1 / periods)), pattern))
    return worst


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("lane_periodic", ()),
        ("lane_periodic", ("mode=zoh", delayed(0.6))),
        ("double_integrator", (PERIODIC, "controller.rate_hz=40", "controller.phase=0.3")),
        ("double_integrator", (PERIODIC, "controller.rate_hz=16", delayed(0.07))),
        ("double_integrator", (PERIODIC, "controller.phase=0", delayed(0.2))),
        ("double_integrator", (PERIODIC, "controller.rate_hz=16", "controller.phase=0", delayed(0.27))),
    ],
)
def test_the_matrices_are_those_of_noack(name: str, settings: Sequence[str]) -> None:
    """Traces of products are the same in all coordinates."""
    resolved = scenario(name, *settings)
    loop = periodic(name, *settings)
    own = loop_of(resolved)
    period = round(float(loop.period.p) / float(loop.period.q) * 1e9)
    times = loop_times(resolved, period // resolved.timing.measurement_period_ns)
    exact = TimeTriggeredLoop(own.A, own.B, own.K, own.H, times)
    assert len(loop.lost) == times.slots
    for slot, outcomes in product(range(times.slots), product([True, False], repeat=4)):
        ours = theirs = np.eye(loop.lost[0].nrows())
        for k, is_delivered in enumerate(outcomes):
            at = (slot + k) % times.slots
            ours = floats((loop.delivered if is_delivered else loop.lost)[at]) @ ours
            theirs = exact.period(at, is_delivered).middle @ theirs
        assert np.trace(ours) == pytest.approx(np.trace(theirs), rel=1e-10, abs=1e-10)


def accepted(loop: PeriodicLoop) -> tuple[dict[str, object], float]:
    """Return a witness of what is found of a loop, and its bound."""
    growth, pattern = worst_growth(loop)
    if growth >= 1:
        document, what = unstable_document(loop, [letter == "D" for letter in pattern])
        assert what.lower is not None
        assert growth * (1 - 1e-5) <= float(what.lower) <= growth * (1 + 1e-9)
        return copy.deepcopy(dict(document)), float(what.lower)
    document, what = stable_document(loop, growth)
    assert what.upper is not None
    assert growth <= float(what.upper) < 1
    return copy.deepcopy(dict(document)), float(what.upper)


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("lane_periodic", ()),
        ("lane_periodic", ("network.mansd=6",)),
        ("lane_periodic", ("mode=zoh",)),
        ("lane_periodic", ("network.mansd=9", "network.constraints=[{kind='at_most', losses=3, window=5}]")),
        ("double_integrator", (PERIODIC, "controller.rate_hz=16", delayed(0.07))),
        ("double_integrator", (PERIODIC, delayed(0.25))),
        ("unstable_pendulum", ("trigger={policy='periodic', period_s=0.05}",)),
    ],
)
def test_a_witness_is_found_and_proves_what_short_patterns_do(name: str, settings: Sequence[str]) -> None:
    loop = periodic(name, *settings)
    try:
        accepted(loop)
    except NoWitnessError:
        pytest.fail(f"growth {worst_growth(loop)} has no witness")


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
    """Return a witness with one change: of its factor, losses, words or one entry of a form."""
    changed = copy.deepcopy(dict(document))
    stable = changed["stable"]
    words, kind = stable["words"], rng.integers(0, 5)
    word = str(rng.choice(list(words)))
    if kind == 0:
        stable["factor"] *= float(rng.choice([0.9, 0.95, 0.98, 1.05]))
    elif kind == 1:
        changed["losses"] += int(rng.choice([-1, 1, 2]))
    elif kind == 2:
        del words[word]
    elif kind == 3:
        other = str(rng.choice(list(words)))
        words[word], words[other] = words[other], words[word]
    else:
        P = words[word][0]
        i, j = rng.integers(0, len(P), 2)
        P[i][j] = P[j][i] = P[i][j] * (1 + 0.3 * rng.normal())
    return changed


@pytest.mark.parametrize("seed", range(4))
def test_what_is_accepted_of_changed_witnesses_is_true(seed: int) -> None:
    rng = np.random.default_rng(seed)
    resolved = scenario(*SMALL)
    content = resolved_content(resolved, resolved.certificate.late_periods)
    loop = read_periodic_loop(content)
    document, _ = accepted(loop)
    rejected = 0
    for number in range(60):
        is_scenario = number % 2 == 0
        other_loop = read_periodic_loop(changed_scenario(content, rng)) if is_scenario else loop
        other = document if is_scenario else changed_document(document, rng)
        try:
            what = prove_growth(other_loop, other)
        except RejectedError:
            rejected += 1
            continue
        assert what.upper is not None
        assert worst_growth(other_loop._replace(losses=what.losses))[0] <= float(what.upper)
    assert 10 < rejected < 60


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

    words = table["words"]
    without = {word: forms for word, forms in words.items() if word != "D"}
    rejects('"D" among them', stable={**table, "words": without})
    rejects("not above 0", stable={**table, "factor": 0.0})
    rejects("the inequality from", stable={**table, "factor": 0.9 * table["factor"]})
    rejects("no word is at the end of DLLLL", losses=9)
    rejects("not one matrix for each slot", stable={**table, "words": {**words, "D": []}})
    size = loop.lost[0].nrows()
    flat = np.zeros((size, size)).tolist()
    rejects("not positive definite", stable={**table, "words": {**words, "D": [flat] * len(loop.lost)}})
    ones: Matrix = np.ones((size, size))
    rejects(
        "not positive definite", stable={**table, "words": {**words, "D": [ones.tolist()] * len(loop.lost)}}
    )
    with pytest.raises(RejectedError, match="neither stable nor unstable"):
        prove_growth(loop, {"losses": 3})
    for pattern, reason in (
        ("LLLL", "does not allow it"),
        ("DLLLL", "does not allow it"),
        ("DX", "not of letters"),
    ):
        with pytest.raises(RejectedError, match=reason):
            prove_growth(loop, {"losses": 3, "unstable": {"pattern": pattern, "squarings": 3}})


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
        (("trigger={policy='absolute', delta=0.1}",), "not time-triggered"),
        ((PERIODIC, "network.impairments=[{kind='delay', delay_s=0.01, jitter_s=0.005}]"), "not constant"),
        ((PERIODIC, "plant.rate_hz=30.0", "controller.rate_hz=30.0"), "no whole nanoseconds"),
        ((PERIODIC, "plant.disturbances=[{kind='uniform', bound=[0.1]}]"), "without observer, noise and"),
        ((PERIODIC, "plant.measurement.noise_bound=[0.1, 0.1]"), "without observer, noise and"),
    ],
)
def test_what_is_not_covered_is_refused(settings: Sequence[str], reason: str) -> None:
    with pytest.raises(RefusedError, match=reason):
        periodic("double_integrator", *settings)


def test_an_observer_that_learns_nothing_is_not_called_stable() -> None:
    """x̂ = 0 and u = 0 at all times, while x grows."""
    plant = ("plant.draw=given", "plant.A=[[0.0, 1.0], [0.0, 0.0]]", "plant.B=[[0.0], [1.0]]")
    resolved = scenario("double_integrator", *plant, PERIODIC)
    content = resolved_content(resolved, resolved.certificate.late_periods)
    content["observer"] = {"kind": "luenberger", "gain": [[0.0, 0.0]] * 2, "initial_estimate": [0.0, 0.0]}
    with pytest.raises(RefusedError, match="observer"):
        read_periodic_loop(content)


def test_the_command_writes_what_noack_check_proves(tmp_path: Path) -> None:
    path = tmp_path / "growth.json"
    result = invoke("margin", "lane_periodic", "--no-period", "--witness", str(path))
    assert result.stdout.count("proved by noack-check: with") == 2
    lines = list(check_file(json.loads(path.read_text()), None))
    start = "PROVED lane_periodic, its plant, its schedule, nothing late: "
    assert [line.startswith(start) for line in lines] == [True, True]
    file = json.loads(path.read_text())
    file["statements"][0]["plants"] = "box"
    with pytest.raises(RejectedError, match="growth: is of the plant itself"):
        list(check_file(file, None))
