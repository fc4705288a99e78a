"""``noack scenarios`` lists the shipped scenarios and prints them."""

import json
import tomllib
from pathlib import Path

import pytest

from noack.scenario.scenario_file import load
from tests.helpers.command_line import invoke

ROOT = Path(__file__).parents[3]
SCENARIOS = sorted(file.stem for file in (ROOT / "scenarios").glob("*.toml"))
CAMPAIGNS = sorted(file.stem for file in (ROOT / "campaigns").glob("*.toml"))


def test_all_shipped_scenarios_are_listed_with_their_description() -> None:
    document = json.loads(invoke("scenarios", "--json").stdout)
    assert [entry["name"] for entry in document["scenarios"]] == SCENARIOS
    assert [entry["name"] for entry in document["campaigns"]] == CAMPAIGNS
    result = invoke("scenarios")
    assert result.exit_code == 0
    lines = [" ".join(line.split()) for line in result.stdout.splitlines()]  # one line each
    for folder, names in (("scenarios", SCENARIOS), ("campaigns", CAMPAIGNS)):
        for name in names:
            content = tomllib.loads((ROOT / folder / f"{name}.toml").read_text("utf-8"))
            assert f"{name} {content['description']}" in lines


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_printed_scenario_loads_from_any_folder(name: str, tmp_path: Path) -> None:
    result = invoke("scenarios", name)
    assert result.exit_code == 0
    copy = tmp_path / "mine.toml"
    copy.write_text(result.stdout, encoding="utf-8")
    assert load(copy) == load(ROOT / "scenarios" / f"{name}.toml")
    assert "schema" not in result.stdout  # which is in another folder
