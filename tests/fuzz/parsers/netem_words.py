"""Words of ``tc netem``, files of links, and requests to a running emulator."""

import json
import socket
from collections.abc import Callable
from http import HTTPStatus
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import tomli_w

from netem.control.command_queue import AppliedSettings
from netem.control.control_routes import ControlRoutes, LinkChange
from netem.core.errors import CallerError
from netem.explanation import tc_command
from netem.impairments.kinds.delay import SHAPES
from netem.impairments.link_settings import Counters, LinkSettings
from netem.links_file import json_schema, load_links
from netem.relay.relay_reports import DIRECTIONS
from netem.tc_words import EXAMPLES as ANY_WORD
from netem.tc_words import parse, settings_of, words_of
from tests.fuzz.edits import NAMED, Choices, Vocabulary, damaged, edited, quoted, vocabulary, write_named
from tests.fuzz.harness import refusal, workspace
from tests.netem.control.fake_relay import FakeRelay
from tests.netem.impairments.any_link_settings import words_can_say
from tests.netem.impairments.feature_examples import CONSTRAINED, IMPAIRED

EXAMPLES = (
    *(example.text() for example in (*IMPAIRED, *CONSTRAINED)),
    "mansd 4", "first", "limit 100", "seed 7", "slot 1ms", "ecn",
)  # fmt: skip
TOKENS = (
    *ANY_WORD, *SHAPES, "none", "./normal",
    "5%", "100%", "99.9%", "0", "1", "2.5", "1e-3%", "10ms", "1s", "1e400s", "3600s", "1us", "-1ms",
    "1mbit", "10tbps", "1/2", "3,4", "0s-1s", "1s-0s", "18446744073709551615", "1e-400", "'", '"',
    "a b", "\\", "",
)  # fmt: skip
WORDS_SEEDS = [example.encode() for example in EXAMPLES]
WORDS_WORDS = [token.encode() for token in TOKENS if token]


def sentence(choices: Choices) -> str:
    """Return some examples with some words replaced."""
    words = [word for _ in range(1 + choices.below(4)) for word in choices.choose(EXAMPLES).split()]
    for _ in range(choices.below(4)):
        at = choices.below(len(words))
        match choices.below(5):
            case 0:
                words[at] = choices.choose(TOKENS)
            case 1:
                words.insert(at, choices.choose(TOKENS))
            case 2 if len(words) > 1:
                del words[at]
            case 3:
                words[at] = words[at][: choices.below(8)] + choices.choose(TOKENS)
            case _:
                words[at] = choices.text()
    return " ".join(words)


def words_input(choices: Choices) -> None:
    """Words are refused, or mean the same when they are written again."""
    if choices.below(4):
        text = sentence(choices)
    else:
        text = choices.near(WORDS_SEEDS, WORDS_WORDS).decode("utf-8", "replace")
    for words in (text, text.split(" ")):
        with refusal():
            _check(words)


def _check(words: str | list[str]) -> None:
    parsed = parse(words)
    text = words_of(parsed.settings)
    try:
        assert parse(text).settings == parsed.settings, text
    except CallerError as error:
        raise AssertionError(f"written settings cannot be read: {error}") from error
    assert words_of(parse(text).settings) == text
    tc_command(parsed.settings)
    for impairment in parsed.settings.impairments:
        impairment.meaning()


_LINKS_SCHEMA = vocabulary(json_schema(), dates=True)
LINKS_KNOWN = _LINKS_SCHEMA._replace(
    words=(
        *_LINKS_SCHEMA.words, *NAMED, ":9000", "[::1]:9000", "127.0.0.1:9001", ":70000",
        "nowhere:1", "::", "loss 5% mansd 4", "delay 10ms 2ms", "loss gemodel 1% 10%",
        "rate 1mbit", "up", "down",
    )
)  # fmt: skip
BASE = {
    "link": [
        {
            "name": "up", "listen": ":9000", "to": "127.0.0.1:9001", "seed": 7, "idle_s": 5.0,
            "words": "delay 10ms 2ms loss gemodel 1% 10% mansd 4 first",
            "reverse": {
                "mansd": 3,
                "impairments": [
                    {"kind": "loss", "loss": {"model": "trace", "file": "trace.txt"}},
                    {"kind": "delay", "delay_s": 0.01, "distribution": "empirical",
                     "samples_s": [0.0, 0.1]},
                    {"kind": "rate", "rate_bps": 1000},
                    {"kind": "blackout", "intervals_s": [[1.0, 2.0]], "every_s": 5.0},
                ],
            },
        },
        {"name": "down", "listen": "[::1]:9000", "to": "[::1]:9001", "return_path": False},
    ]
}  # fmt: skip
LINKS_SEEDS = [tomli_w.dumps(BASE).encode()]
LINKS_WORDS = (*quoted(LINKS_KNOWN), *WORDS_WORDS)
_LOOK_UP: Callable[..., Any] = socket.getaddrinfo


def numeric(host: str, port: int, family: int, kind: int) -> Any:
    """Resolve an address without network access."""
    flags = socket.AI_NUMERICHOST
    return _LOOK_UP(host, port, family=family, type=kind, flags=flags)


def links_input(choices: Choices) -> None:
    """A file of links is refused, or its settings survive JSON and words."""
    if choices.below(4):
        content: dict[str, Any] = json.loads(json.dumps(BASE))
        if choices.flag():
            content["link"][0]["words"] = sentence(choices)
        data = tomli_w.dumps(edited(choices, content, LINKS_KNOWN)).encode()
    else:
        data = choices.near(LINKS_SEEDS, LINKS_WORDS)
    path = write_named(workspace(), "links.toml", data)
    with refusal(str(path), lines=True), patch("netem.core.address.socket.getaddrinfo", numeric):
        for spec in load_links(path):
            for settings in (spec.forward, spec.reverse):
                assert LinkSettings.model_validate_json(settings.model_dump_json()) == settings
                if words_can_say(settings):
                    assert settings_of(words_of(settings)) == settings


_CONTROL_SCHEMA = vocabulary(LinkChange.model_json_schema())
CONTROL_KNOWN = Vocabulary(_CONTROL_SCHEMA.keys, (*_CONTROL_SCHEMA.words, "up", "down", *EXAMPLES))
BASES: list[dict[str, Any]] = [
    {"forward": "loss 5% mansd 4", "reverse": "delay 10ms 2ms"},
    {"reverse": "delay 10ms 2ms"},
    {
        "forward": {
            "mansd": 3,
            "impairments": [
                {"kind": "loss", "loss": {"model": "gilbert_elliott", "mean_loss": 0.1,
                                          "mean_burst": 3.0}},
                {"kind": "delay", "delay_s": 0.1, "jitter_s": 0.1, "distribution": "normal"},
                {"kind": "rate", "rate_bps": 1000},
            ],
        },
    },
]  # fmt: skip
CONTROL_SEEDS = [json.dumps(base).encode() for base in BASES]
CONTROL_WORDS = [json.dumps(word).encode() for word in (*CONTROL_KNOWN.keys, *CONTROL_KNOWN.words)]


class _AtOnce:
    """A command queue that runs commands at once, in this thread."""

    def __init__(self) -> None:
        self.relay = FakeRelay("up", "down")

    @property
    def links(self) -> list[str]:
        return [spec.name for spec in self.relay.specs]

    def change(self, link: str, changes: Any) -> None:
        for direction, settings in changes.items():
            self.relay.change(link, direction, settings)

    def snapshot(self) -> Any:
        applied = {
            key: AppliedSettings(settings, Counters()) for key, settings in self.relay.settings.items()
        }
        return SimpleNamespace(links=self.relay.report(), applied=applied)


def control_input(choices: Choices) -> None:
    """A request is answered once; a refused one changes no settings."""
    if choices.below(4):
        base = json.loads(json.dumps(choices.choose(BASES)))
        if choices.flag():
            base[choices.choose(DIRECTIONS)] = sentence(choices)
        data = damaged(choices, json.dumps(edited(choices, base, CONTROL_KNOWN)).encode())
    else:
        data = choices.near(CONTROL_SEEDS, CONTROL_WORDS)
    commands = _AtOnce()
    routes = ControlRoutes(commands, lambda: None)  # type: ignore[arg-type, return-value]
    before = dict(commands.relay.settings)
    answer = routes.answer("PATCH", "/links/up", data)
    content = json.loads(answer.content)
    if answer.status == HTTPStatus.BAD_REQUEST:
        assert all(line.isprintable() for line in content["error"].splitlines())
        assert commands.relay.settings == before, "a refused request changed settings"
    else:
        assert answer.status == HTTPStatus.OK, content
        for direction in DIRECTIONS:
            settings = LinkSettings.model_validate_json(json.dumps(content[direction]["settings"]))
            assert settings == commands.relay.settings["up", direction]


PARSERS = {
    "words": words_input,
    "links": links_input,
    "control": control_input,
}
