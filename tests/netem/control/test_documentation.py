"""docs/netem-control.md agrees with the code."""

import io
import json
import re
from contextlib import redirect_stdout
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from netem.__main__ import main
from netem.control import emulator_statistics
from netem.control.control_server import ControlServer
from netem.fates import SCHEMA, FateRecorder
from netem.tc_words import settings_of
from tests.netem.control.relays import FakeRelay, running
from tests.netem.fates.links import spec_of

PAGE = (Path(__file__).parents[3] / "docs/netem-control.md").read_text()


def rows(title: str) -> dict[str, str]:
    """Return the table with this title as a mapping from first column to second column."""
    (table,) = re.findall(rf"^\| {title} \| \|\n\|---\|---\|\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    return dict(row.strip("| \n").split(" | ", 1) for row in table.splitlines())


def names(text: str) -> set[str]:
    return set(re.findall("`([a-z0-9_]+)`", text))


def explained() -> dict[str, Any]:
    out = io.StringIO()
    with redirect_stdout(out):
        assert main(["--explain", "--json", "loss 5%"]) == 0
    (link,) = json.loads(out.getvalue())["links"]
    return dict(link)


@pytest.mark.parametrize(
    ("title", "keys"),
    [
        ("document", get_type_hints(emulator_statistics.Statistics)),
        ("link", get_type_hints(emulator_statistics.LinkStatistics)),
        ("direction", get_type_hints(emulator_statistics.DirectionStatistics)),
        ("recent", get_type_hints(emulator_statistics.RecentRates)),
        ("column", dict.fromkeys(SCHEMA.names)),
        ("key", dict.fromkeys(("report", "settings", "change", "statistics"))),
        ("explained link", explained()),
        ("explained direction", explained()["forward"]),
    ],
)
def test_every_key_is_documented_and_no_other(title: str, keys: dict[str, Any]) -> None:
    assert set().union(*map(names, rows(title))) == set(keys)
    text = rows("direction")
    assert names(text["`loss`"]) == set(get_type_hints(emulator_statistics.LossStatistics))
    assert names(text["`flows`"]) == set(get_type_hints(emulator_statistics.FlowStatistics))
    assert names(text["`delay_ns`"]) == set(get_type_hints(emulator_statistics.DelayQuantiles))


def test_the_documented_programs_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first controls an emulator, the second reads the metadata of a fate trace."""
    relay = FakeRelay("relay")
    change, read = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    with running(relay) as commands, ControlServer("lab", commands):
        exec(change, {})
    assert capsys.readouterr().out == "None\n"
    assert relay.settings["relay", "reverse"].mansd == 2
    with FateRecorder(tmp_path / "monday.parquet", [spec_of(settings_of("mansd 3"), "relay")]):
        pass
    monkeypatch.chdir(tmp_path)
    exec(read, {})
    assert capsys.readouterr().out.split() == [version("noack"), "0", "3"]
