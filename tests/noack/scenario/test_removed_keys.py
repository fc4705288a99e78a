"""A scenario that uses a removed key or kind is told the plain way, wherever the key is written."""

from pathlib import Path

import pytest

from noack.core.errors import CallerError
from noack.scenario import removed_keys
from noack.scenario.scenario_file import load

SCENARIO = Path(__file__).parents[3] / "scenarios" / "lane_following.toml"


@pytest.fixture(autouse=True)
def _two_removals(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = {"network.gone": "do it yourself", "impairments.kind = teleport": "walk", "mode = guess": "know"}
    monkeypatch.setattr(removed_keys, "REMOVED", rows)


def message(*settings: str) -> str:
    with pytest.raises(CallerError) as caught:
        load(SCENARIO, settings)
    return str(caught.value)


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        ("network.gone=3", "network.gone = 3: was removed; do it yourself"),
        ("network.loss.gone=3", "network.loss.gone = 3: unknown key; "),
        ("network.impairments=[{kind='teleport'}]", 'impairments.0.kind = "teleport": was removed; walk'),
        ("network.impairments=[{kind='gone'}]", 'network.impairments.0.kind = "gone": must be one of '),
        ("gone=3", "gone = 3: unknown key; "),
        ("mode=guess", 'mode = "guess": was removed; know'),
    ],
)
def test_only_a_removed_name_is_told_the_plain_way(setting: str, line: str) -> None:
    assert line in message(setting)
    assert message(setting).startswith("--set ")


def test_a_file_is_told_the_plain_way_of_a_removed_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(removed_keys, "REMOVED", {"gone.after_s": "wait"})
    file = tmp_path / "scenario.toml"
    file.write_text(SCENARIO.read_text(encoding="utf-8") + "\n[gone]\nafter_s = 3\n", encoding="utf-8")
    with pytest.raises(CallerError, match=r"^\S+scenario\.toml: gone\.after_s = 3: was removed; wait$"):
        load(file)
