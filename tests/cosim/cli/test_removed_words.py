"""Who uses a command or an option of an earlier build is told the plain way, in one line."""

from pathlib import Path

import pytest

from cosim.cli.removed_words import REMOVED
from netem.emulator_options import command_line_parser, parse_options
from noack.core.errors import CallerError
from tests.helpers.command_line import invoke


@pytest.mark.parametrize("words", REMOVED)
def test_a_removed_word_is_told_the_plain_way(words: str) -> None:
    value = ["there"] if "--" in words else []
    result = invoke(*words.split(), *value)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr == f"noack: noack {words}: was removed; {REMOVED[words]}\n"


def test_other_words_are_only_unknown() -> None:
    assert "no such command 'capacities'" in invoke("capacities").stderr
    assert invoke("simulate", "--hosts", "there").stderr.startswith(
        "noack: simulate: no such option: --hosts"
    )


def test_an_option_may_be_before_a_removed_command() -> None:
    result = invoke("--json", "paper")
    assert result.exit_code == 2
    assert result.stderr == f"noack: noack paper: was removed; {REMOVED['paper']}\n"


@pytest.mark.parametrize("option", ["--capture", "--record-fates=a", "--replay-fates", "--view"])
def test_a_removed_option_of_the_emulator_is_told_the_plain_way(option: str) -> None:
    with pytest.raises(CallerError, match=f"^{option.partition('=')[0]}: was removed; "):
        parse_options(command_line_parser(), [option, "a", "loss", "5%"])


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("loops = 3", 'loops = 3: was removed; in a campaign, the key "loops.0.count"'),
        ("[metrics]\ncost_of_a = 1", "metrics.cost_of_a = 1: was removed; the metric cost"),
        ('[metrics]\nshown = ["cost_of_a"]', 'metrics.shown.0 = "cost_of_a": was removed; the metric cost'),
    ],
)
def test_a_removed_key_of_a_campaign_is_told_the_plain_way(tmp_path: Path, lines: str, message: str) -> None:
    file = tmp_path / "c.toml"
    file.write_text(f'name = "a"\nscenario = "lane_following"\n{lines}\n', encoding="utf-8")
    assert message in invoke("campaign", str(file)).stderr
