"""Words of ``tc netem``: text as it stands, or, after a zero byte, a sentence of its words."""

from netem.words.explanation import meaning_of
from netem.words.settings_to_words import text_of
from netem.words.tc_command import tc_command
from netem.words.words_to_settings import KEYWORDS, SHAPES, parse
from noack.core.errors import CallerError
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.harness import refusal

EXAMPLES = (
    "loss 5% 25%", "loss random 5%", "loss gemodel 1% 10% 90% 2%", "loss state 1% 50% 1% 90% 2%",
    "loss burst 5% 3", "loss periodic 2/100 from 3", "loss script 3,4,17 every 20",
    "loss script none", "loss trace trace.txt once", "loss worst", "loss none",
    "delay 10ms 2ms 25% distribution normal lossrel 80%", "delay 10ms distribution delays.txt",
    "delay 0s samples 1ms,-2ms,10ms", "duplicate 1% 5%", "corrupt 0.1%", "reorder 25% 50% gap 5",
    "gap 5", "rate 1mbit 14 48 5 queue 100", "blackout 2s-3s,5s-5500ms every 10s",
    "mansd 4", "first", "limit 100", "seed 7", "slot 1ms", "ecn",
)  # fmt: skip
TOKENS = (
    *KEYWORDS, *SHAPES, "gemodel", "state", "burst", "periodic", "script", "trace", "worst", "none",
    "random", "distribution", "samples", "lossrel", "queue", "once", "from", "every", "./normal",
    "5%", "100%", "99.9%", "0", "1", "2.5", "1e-3%", "10ms", "1s", "1e400s", "3600s", "1us", "-1ms",
    "1mbit", "10tbps", "1/2", "3,4", "0s-1s", "1s-0s", "18446744073709551615", "1e-400", "'", '"',
    "a b", "\\", "",
)  # fmt: skip
SEEDS = [*EDITS, *(one.encode() for one in EXAMPLES)]
WORDS = [token.encode() for token in TOKENS if token]


def sentence(choices: Choices) -> str:
    """Some examples, in which some words are others."""
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
    said = parse(words)
    again = text_of(*said)
    try:
        assert parse(again) == said, again
    except CallerError as error:
        raise AssertionError(f"what is said of settings is not understood: {error}") from error
    assert text_of(*parse(again)) == again
    tc_command(said.settings)
    for impairment in said.settings.impairments:
        meaning_of(impairment)
