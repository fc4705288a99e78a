"""``--explain`` describes links."""

import json
import shlex
from pathlib import Path

import pytest

from netem.__main__ import main
from netem.emulator_options import command_line_parser as parser
from netem.emulator_options import specs_of
from netem.links_file import load_links
from tests.helpers.approved import compare_lines


class Explain:
    """Runs the program and returns its output."""

    def __init__(self, capsys: pytest.CaptureFixture[str], patch: pytest.MonkeyPatch) -> None:
        self._capsys, self._patch = capsys, patch

    def __call__(self, *arguments: str, columns: int = 80) -> str:
        self._patch.setenv("COLUMNS", str(columns))
        assert main(["--explain", *arguments]) == 0
        out, err = self._capsys.readouterr()
        assert err == ""
        return out


@pytest.fixture
def explain(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Explain:
    return Explain(capsys, monkeypatch)


LINKS = """
[[link]]
name = "uplink"
listen = "127.0.0.1:9000"
to = "[::1]:9001"
words = "loss 50% mansd 4"
reverse = "delay 10ms"
seed = 7

[[link]]
name = "video"
listen = "127.0.0.1:9002"
to = "127.0.0.1:9003"
return_path = false
words = "loss 20%"
"""


def test_links_are_explained_by_the_approved_text(
    explain: Explain, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tables fit into a terminal of 80 columns, and the file of links has the same meaning."""
    monkeypatch.chdir(tmp_path)
    Path("links.toml").write_text(LINKS)

    def explained(arguments: str) -> list[str]:
        given = shlex.split(arguments)
        text = explain(*given)
        if "--json" in given:  # rates are compared without their rounding
            text = json.dumps(json.loads(text, parse_float=lambda digits: round(float(digits), 9)), indent=2)
        else:
            tables, _, file = text.partition("(--links)\n")
            assert max(map(len, tables.splitlines())) <= 80
            Path("again.toml").write_text(file or LINKS)
            assert load_links(Path("again.toml")) == specs_of(
                parser().parse_intermixed_args(["--explain", *given])
            )
        return [line.rstrip() for line in text.splitlines() if line.strip()]

    compare_lines(Path(__file__).with_name("explained.txt"), explained)
