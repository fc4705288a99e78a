"""Words in the syntax of tc."""

from pathlib import Path

import pytest
from hypothesis import assume, given

from netem.core.errors import CallerError
from netem.impairments.link_settings import MOST_IMPAIRMENTS, LinkSettings
from netem.tc_words import parse, settings_of, words_of
from tests.helpers.approved import compare_lines, lines_of_error
from tests.netem.impairments.any_link_settings import settings, words_can_say


def test_words_are_the_approved_impairments() -> None:
    def impairments(words: str) -> list[str]:
        parsed, seed, _ = parse(words)
        assert seed is None
        assert settings_of(words_of(parsed)) == parsed
        return [impairment.model_dump_json(exclude_unset=True) for impairment in parsed.impairments]

    compare_lines(Path(__file__).with_name("word_settings.txt"), impairments)


def test_settings_may_come_anywhere_and_impairments_keep_their_order() -> None:
    words = "mansd 4 delay 10ms limit 50 loss 5% seed 7 delay 1ms first"
    settings, seed, _ = parse(words)
    assert (settings.mansd, settings.limit, settings.first_delivered, seed) == (4, 50, True, 7)
    assert [impairment.kind for impairment in settings.impairments] == ["delay", "loss", "delay"]
    assert words_of(settings) == "delay 10ms loss 5% delay 1ms mansd 4 first limit 50"
    text = "loss trace 'my file' mansd 4"
    for listed in (["loss", "trace", "my file", "mansd", "4"], ["loss trace 'my file'", "mansd 4"]):
        assert settings_of(listed) == settings_of(text)
        assert words_of(settings_of(listed)) == text


@given(settings)
def test_all_settings_survive_being_written_and_read(settings: LinkSettings) -> None:
    assume(words_can_say(settings))  # another test covers refused settings
    text = words_of(settings)
    assert settings_of(text) == settings
    assert "'" in text or settings_of(text.split()) == settings


def test_the_lines_about_mistakes_are_those_that_were_approved() -> None:
    compare_lines(
        Path(__file__).with_name("word_mistakes.txt"), lambda words: lines_of_error(lambda: parse(words))
    )


def test_there_is_a_limit_on_the_number_of_impairments() -> None:
    assert len(settings_of("loss 5% " * MOST_IMPAIRMENTS).impairments) == MOST_IMPAIRMENTS
    with pytest.raises(CallerError, match=r"^1025 impairments; expected at most 1024$"):
        settings_of("loss 5% " * 1025)
