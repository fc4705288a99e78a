"""Random whole scenarios, from reading to the worst losses; thousands of them are ``make fuzz``."""

from collections import Counter
from pathlib import Path

import pytest
from flint import arb

from cosim.simulation.virtual_time import simulate_run
from netem.core.errors import CallerError
from noack.proof.search.results import FoundBound, Proof
from noack.scenario.scenario_file import load
from tests.fuzz.scenarios import __main__ as command
from tests.fuzz.scenarios.check_draw import Checked, Checks, Contradiction, check_draw, fault_of_message
from tests.fuzz.scenarios.draws import NEVER_DRAWN, draw, drawn_keys, schema_keys
from tests.helpers.shipped import shipped

SEED = 71
FEW = {0, 1, 2, 3, 4, 5, 6, 7, 9, 10}
DRAWS = [pytest.param(number, marks=() if number in FEW else pytest.mark.deep) for number in range(31)]
"""Draws that are checked; few of them by every ``make test``."""
MANY = 2000
"""Draws, at most, that together set every key."""


@pytest.mark.parametrize("number", DRAWS)
def test_a_draw_has_no_contradiction(number: int) -> None:
    checked = check_draw(SEED, number)
    found = [f"{step}: {what}\n{detail}" for *_, step, what, detail in checked.contradictions]
    assert not found, "\n".join(found)


def test_few_draws_are_refused(tmp_path: Path) -> None:
    refused = []
    for number in range(MANY // 20):
        try:
            load(draw(SEED, number).write(tmp_path / str(number)))
        except CallerError as error:
            refused.append(str(error))
    assert len(refused) < MANY // 20 // 10, "\n".join(refused)


def test_every_key_is_drawn_or_listed_with_a_reason() -> None:
    missing = schema_keys()
    for number in range(MANY):
        missing -= drawn_keys(draw(SEED, number).content)
        if missing <= NEVER_DRAWN.keys():
            break
    assert missing == NEVER_DRAWN.keys()


def test_a_draw_is_a_function_of_seed_and_number() -> None:
    assert draw(SEED, 3) == draw(SEED, 3)
    assert draw(SEED, 3).content != draw(SEED, 4).content


@pytest.mark.parametrize("status", [0, 1])
def test_the_command_prints_a_contradiction_with_its_file(
    status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = [Contradiction(SEED, 3, "claims", "a bound is exceeded", "by 2 %")] * status
    checked = Checked(SEED, 3, False, found, set(), Counter(), Counter())
    monkeypatch.setattr(command, "checked_draws", lambda *_, **__: iter([checked]))
    assert command.main(["--failures", str(tmp_path)]) == status
    output = capsys.readouterr().out
    path = tmp_path / f"{SEED}-3" / "scenario.toml"
    assert (f"draw 3 of seed {SEED} ({path}): claims: a bound is exceeded\n    by 2 %" in output) == bool(
        status
    )
    assert path.exists() == bool(status)
    assert f"{status} with a contradiction" in output


@pytest.mark.deep
def test_each_fifth_draw_is_searched_for_witnesses(capsys: pytest.CaptureFixture[str]) -> None:
    for options in (["19", "20"], ["19", "--witnesses"]):
        assert command.main(["--seed", f"{SEED}", "--processes", "1", "--only", *options]) == 0
        assert "  prove, schedule: 1\n" in capsys.readouterr().out


def test_a_run_that_exceeds_a_proven_bound_is_a_contradiction(tmp_path: Path) -> None:
    scenario = shipped("double_integrator", "horizon_s=2.0")
    ending = simulate_run(scenario, tmp_path)
    outputs = ("x", "x[0]", "y[0]", "e_s", "e_c")
    for size, is_exceeded in ((10.0, False), (1e-4, True)):
        checks = Checks(draw(SEED, 0), tmp_path, 60.0)
        bounds = tuple(FoundBound(output, arb(size), arb(0), from_start=True) for output in outputs)
        checks.compare(ending, Proof(arb(0), bounds, None, None, is_quiet=True))
        found = [contradiction.what.partition(" =")[0] for contradiction in checks.contradictions]
        assert found == [f"‖{output}‖" for output in outputs if is_exceeded]


def test_a_search_that_takes_too_long_is_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    checks = Checks(draw(SEED, 0), tmp_path, 0.05)
    with checks.step("prove", searches=True):
        while True:
            pass
    assert (checks.contradictions, checks.counts) == ([], {"prove: search too long": 1})
    checked = Checked(SEED, 3, False, [], set(), checks.counts, Counter())
    monkeypatch.setattr(command, "checked_draws", lambda *_, **__: iter([checked]))
    assert command.main(["--failures", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert f"draw 3 of seed {SEED}: prove: search too long\n" in output
    assert "0 with a contradiction\n  prove: search too long: 1" in output


def test_a_step_that_raises_or_takes_too_long_is_a_contradiction(tmp_path: Path) -> None:
    checks = Checks(draw(SEED, 0), tmp_path, 0.05)
    with checks.step("raises"):
        raise ZeroDivisionError
    with checks.step("is slow"):
        while True:
            pass
    with checks.step("is refused"):
        raise CallerError("a.toml: trigger.beta: expected more than 0")
    assert [(c.step, c.what.partition(":")[0]) for c in checks.contradictions] == [
        ("raises", "ZeroDivisionError"),
        ("is slow", "more than 0.05 s of CPU time"),
    ]


@pytest.mark.parametrize(
    ("message", "fault"),
    [
        ("a.toml: trigger.beta: expected more than 0", None),
        ("a.toml: plant.A: wrong\na.toml: plant.B: wrong", "not one line"),
        ("x" * 800, "800 letters"),
        ("a.toml: <class 'float'> is wrong", "not for a user"),
    ],
)
def test_a_message_is_one_clear_line(message: str, fault: str | None) -> None:
    assert fault_of_message(message) == fault
