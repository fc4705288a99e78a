"""docs/netem-control.md agrees with the code."""

import re
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from netem.control import emulator_statistics
from netem.control.control_server import ControlServer
from netem.fates import SCHEMA, FateRecorder
from netem.relay_links import LinkSpec
from netem.tc_words import settings_of
from noack.impairments.link_settings import LinkSettings
from tests.netem.control.relays import FakeRelay, running

NOTHING = LinkSettings()
PAGE = (Path(__file__).parents[3] / "docs/netem-control.md").read_text()


def rows(title: str) -> dict[str, str]:
    """Return the table with this title as a mapping from first column to second column."""
    (table,) = re.findall(rf"^\| {title} \| \|\n\|---\|---\|\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    return dict(row.strip("| \n").split(" | ", 1) for row in table.splitlines())


def names(text: str) -> set[str]:
    return set(re.findall("`([a-z0-9_]+)`", text))


@pytest.mark.parametrize(
    ("title", "keys"),
    [
        ("document", get_type_hints(emulator_statistics.Statistics)),
        ("link", get_type_hints(emulator_statistics.LinkStatistics)),
        ("direction", get_type_hints(emulator_statistics.DirectionStatistics)),
        ("recent", get_type_hints(emulator_statistics.RecentRates)),
        ("column", dict.fromkeys(SCHEMA.names)),
        ("key", dict.fromkeys(("report", "settings", "change", "statistics"))),
    ],
)
def test_every_key_is_documented_and_no_other(title: str, keys: dict[str, Any]) -> None:
    assert set().union(*map(names, rows(title))) == set(keys)


def test_nested_keys_are_documented() -> None:
    text = rows("direction")
    assert names(text["`loss`"]) == set(get_type_hints(emulator_statistics.LossStatistics))
    assert names(text["`flows`"]) == set(get_type_hints(emulator_statistics.FlowStatistics))
    assert names(text["`delay_ns`"]) == set(get_type_hints(emulator_statistics.DelayQuantiles))


def programs() -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


def test_the_documented_program_runs(capsys: pytest.CaptureFixture[str]) -> None:
    relay = FakeRelay("relay")
    program, _ = programs()
    with running(relay) as commands, ControlServer("lab", commands):
        exec(program, {})
    assert capsys.readouterr().out == "None\n"
    assert relay.settings["relay", "reverse"].mansd == 2


def test_the_documented_program_reads_the_metadata_of_a_fate_trace(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _, program = programs()
    specs = [LinkSpec("relay", ("127.0.0.1", 1), ("127.0.0.1", 2), settings_of("mansd 3"), NOTHING)]
    with FateRecorder(tmp_path / "monday.parquet", specs):
        pass
    monkeypatch.chdir(tmp_path)
    exec(program, {})
    assert capsys.readouterr().out.split() == [version("noack"), "0", "3"]
