"""Who uses a command or an option of an earlier build is told the plain way, in one line."""

import pytest

from cosim.cli.removed_words import REMOVED
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
