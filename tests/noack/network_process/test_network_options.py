"""``noack netem``: a run's options, and those of an emulator on its own."""

import shlex

import pytest

from noack.network_process.__main__ import main

ALONE = (
    "joins a run and allows only --json beside it; words and all other options belong to an emulator on "
    "its own, which needs --listen and --to, or --links"
)


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("--session x loss 5%", f"--session {ALONE}"),
        ("--session=x --stats 1", f"--session {ALONE}"),
        ("--credentials folder --listen :9000 --to :9001", f"--credentials {ALONE}"),
        ("loss 5%", "--listen and --to are missing, or --links FILE; see --help"),
        ("set lab --session x", "unrecognized arguments: --session"),
    ],
)
def test_a_run_s_options_stand_alone(words: str, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(shlex.split(words)) == 2
    assert line in capsys.readouterr().err


def test_the_help_has_the_options_of_both(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--help"])
    assert end.value.code == 0
    text = capsys.readouterr().out
    for option in ("--listen", "--session NAME", "--credentials FOLDER", "--json", "noack record SCENARIO"):
        assert option in text, option
