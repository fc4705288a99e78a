"""Error messages are printable single lines, whatever text they quote."""

from hypothesis import given
from hypothesis import strategies as st

from noack.core.errors import CallerError, one_line, printable


@given(st.text())
def test_quoted_text_is_one_printable_line(text: str) -> None:
    assert printable(text).isprintable()
    assert printable(text) == text or not text.isprintable()


def test_control_characters_are_escaped_and_each_mistake_has_a_line() -> None:
    assert str(CallerError("key = \x1b[2J\x07é\ud800")) == "key = \\x1b[2J\\x07é\\ud800"
    assert str(CallerError("a: wrong\nb: \twrong")) == "a: wrong\nb: \\twrong"


def test_an_error_of_another_library_becomes_one_line() -> None:
    assert one_line(ValueError("Couldn't read:\n  no data\n")) == "Couldn't read: no data"
