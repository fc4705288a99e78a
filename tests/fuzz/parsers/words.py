"""Words of ``tc netem``: plain text or, after a zero byte, a sequence of valid words."""

from netem.tc_words import EXAMPLES as ANY_WORD
from netem.tc_words import parse, tc_command, text_of
from noack.core.errors import CallerError
from noack.impairments.kinds.delay import SHAPES
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.harness import refusal
from tests.netem.feature_examples import CONSTRAINED, IMPAIRED

EXAMPLES = (
    *(one.text() for one in (*IMPAIRED, *CONSTRAINED)),
    "mansd 4", "first", "limit 100", "seed 7", "slot 1ms", "ecn",
)  # fmt: skip
TOKENS = (
    *ANY_WORD, *SHAPES, "none", "./normal",
    "5%", "100%", "99.9%", "0", "1", "2.5", "1e-3%", "10ms", "1s", "1e400s", "3600s", "1us", "-1ms",
    "1mbit", "10tbps", "1/2", "3,4", "0s-1s", "1s-0s", "18446744073709551615", "1e-400", "'", '"',
    "a b", "\\", "",
)  # fmt: skip
SEEDS = [*EDITS, *(one.encode() for one in EXAMPLES)]
WORDS = [token.encode() for token in TOKENS if token]


def sentence(choices: Choices) -> str:
    """Return some examples with some words replaced."""
    words = [word for _ in range(1 + choices.below(4)) for word in choices.one(EXAMPLES).split()]
    for _ in range(choices.below(4)):
        at = choices.below(len(words))
        match choices.below(5):
            case 0:
                words[at] = choices.one(TOKENS)
            case 1:
                words.insert(at, choices.one(TOKENS))
            case 2 if len(words) > 1:
                del words[at]
            case 3:
                words[at] = words[at][: choices.below(8)] + choices.one(TOKENS)
            case _:
                words[at] = choices.text()
    return " ".join(words)


def one_input(data: bytes) -> None:
    structured = data[:1] == b"\0"
    text = sentence(Choices(data[1:])) if structured else data.decode("utf-8", "replace")
    for words in (text, text.split(" ")):
        with refusal():
            _check(words)


def _check(words: str | list[str]) -> None:
    parsed = parse(words)
    text = text_of(parsed.settings)
    try:
        assert parse(text).settings == parsed.settings, text
    except CallerError as error:
        raise AssertionError(f"written settings cannot be read: {error}") from error
    assert text_of(parse(text).settings) == text
    tc_command(parsed.settings)
    for impairment in parsed.settings.impairments:
        impairment.meaning()
