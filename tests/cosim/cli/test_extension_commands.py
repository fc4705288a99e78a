"""Commands of installed packages, right and wrong ones, in programs of their own."""

from pathlib import Path

import pytest

from tests.helpers.installed_packages import install, run

COMMAND = """
from typing import Annotated
import typer

app = typer.Typer()

@app.command(rich_help_panel="Runs", epilog="Examples:\\n\\n- `noack swing --times 2`: twice")
def NAME(times: Annotated[int, typer.Option(help="How often.")] = 1) -> int:
    "Swing."
    print("swing " * times)
    return times
"""
NOACK = ("-c", "import sys; from cosim.cli import main; sys.argv[0] = 'noack'; main()")
ENTRY_POINT = "[noack.commands]\nswing = swing_commands\n"
STATUS = "import subprocess, sys; print(subprocess.run([sys.executable, *sys.argv[1:]]).returncode)"


def test_a_command_of_a_package_is_one_of_noack(tmp_path: Path) -> None:
    install(tmp_path, "noack-swing", ENTRY_POINT, swing_commands=COMMAND.replace("NAME", "swing"))
    assert run(tmp_path, "-c", STATUS, *NOACK, "swing", "--times", "2") == ("swing swing \n2", [])
    lines = run(tmp_path, *NOACK, "--help")[0].splitlines()
    (row,) = (number for number, line in enumerate(lines) if "Swing." in line)
    (next_panel,) = (number for number, line in enumerate(lines) if "─ Theory ─" in line)
    assert row < next_panel
    _, mistake = run(tmp_path, "-c", STATUS, *NOACK, "swing", "--tmies", "2")
    assert mistake == ["noack: swing: no such option: --tmies; did you mean --times?"]


@pytest.mark.parametrize(
    ("module", "reason"),
    [
        ("import not_there", "ModuleNotFoundError: No module named 'not_there'"),
        ("", "it has nothing for the group noack.commands"),
        (COMMAND.replace("NAME", "run"), "CallerError: there is a command run already"),
        (COMMAND.replace("int,", "object(),").replace("NAME", "swing"), "AttributeError: "),
    ],
)  # fmt: skip
def test_a_broken_package_costs_one_line(tmp_path: Path, module: str, reason: str) -> None:
    install(tmp_path, "noack-swing", ENTRY_POINT, swing_commands=module)
    output, (line,) = run(tmp_path, *NOACK, "scenarios")
    assert "lane_following" in output
    assert line.startswith(
        f"noack: warning: a part of the extension noack-swing is ignored: swing_commands: {reason}"
    )
