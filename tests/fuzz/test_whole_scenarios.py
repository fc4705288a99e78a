"""Random whole scenarios, from reading to the worst losses; thousands of them are ``make fuzz``."""

from pathlib import Path

import pytest

from noack.core.errors import CallerError
from noack.scenario.scenario_file import load
from tests.fuzz.scenarios.check_draw import check_draw, fault_of_message
from tests.fuzz.scenarios.draws import NEVER_DRAWN, draw, drawn_keys, schema_keys

SEED = 71
DRAWS = [number for number in range(31) if number not in (18, 20, 26, 27)]
"""Draws that are checked; the certificates of the others take long."""
MANY = 2000
"""Draws that together set every key."""


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
    keys = set[str]()
    for number in range(MANY):
        keys |= drawn_keys(draw(SEED, number).content)
    assert schema_keys() - keys == NEVER_DRAWN.keys()


def test_a_draw_is_a_function_of_seed_and_number() -> None:
    assert draw(SEED, 3) == draw(SEED, 3)
    assert draw(SEED, 3).content != draw(SEED, 4).content


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
