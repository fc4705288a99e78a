"""``noack scenarios``: the shipped scenarios, and a file to start one's own from."""

import json
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from cosim.cli import app
from noack.config.scenario_file import load

ROOT = Path(__file__).parents[3]
SCENARIOS = sorted(file.stem for file in (ROOT / "scenarios").glob("*.toml"))
CAMPAIGNS = sorted(file.stem for file in (ROOT / "campaigns").glob("*.toml"))


def scenarios(*words: str) -> Result:
    return CliRunner().invoke(app, ["scenarios", *words], prog_name="noack")


def test_all_shipped_scenarios_are_listed_with_their_description() -> None:
    done = scenarios()
    assert done.exit_code == 0
    listed = [" ".join(line.split()) for line in done.stdout.splitlines()]  # one line each
    for folder, names in (("scenarios", SCENARIOS), ("campaigns", CAMPAIGNS)):
        for name in names:
            content = tomllib.loads((ROOT / folder / f"{name}.toml").read_text("utf-8"))
            assert f"{name} {content['description']}" in listed


def test_a_folder_with_a_scenarios_name_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cart_pole").mkdir()
    (found, *_) = json.loads(scenarios("--json").stdout)["scenarios"]
    assert found["name"] == "cart_pole"
    assert load(Path(found["path"])).name == "cart_pole"


def test_the_json_list_contains_readable_files() -> None:
    document = json.loads(scenarios("--json").stdout)
    assert [one["name"] for one in document["scenarios"]] == SCENARIOS
    assert [one["name"] for one in document["campaigns"]] == CAMPAIGNS
    for one in document["scenarios"]:
        assert load(Path(one["path"])).name == one["name"]


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_printed_scenario_loads_from_any_folder(name: str, tmp_path: Path) -> None:
    done = scenarios(name)
    assert done.exit_code == 0
    copy = tmp_path / "mine.toml"
    copy.write_text(done.stdout, encoding="utf-8")
    assert load(copy) == load(ROOT / "scenarios" / f"{name}.toml")
    assert "schema" not in done.stdout  # which is in another folder


@pytest.mark.parametrize("words", [["lane_folowing"], ["lane_folowing", "--json"]])
def test_an_unknown_scenario_name_gives_one_line(words: list[str]) -> None:
    done = scenarios(*words)
    assert done.exit_code == 2
    assert "lane_folowing: not a shipped file; did you mean lane_following?" in (done.stderr)
    assert done.stderr.count("\n") == 1
