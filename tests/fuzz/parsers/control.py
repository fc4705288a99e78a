"""Requests to a running emulator over zenoh."""

import json
from types import SimpleNamespace
from typing import Any

from netem.control.control_server import ControlServer, SettingsChange
from netem.relay_links import DIRECTIONS
from noack.impairments.link_settings import LinkSettings
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.edits import Vocabulary, edited, vocabulary
from tests.fuzz.parsers.words import EXAMPLES, sentence
from tests.fuzz.plane import Query
from tests.fuzz.tables import damaged
from tests.netem.control.relays import FakeRelay

_SCHEMA = vocabulary(SettingsChange.model_json_schema())
KNOWN = Vocabulary(_SCHEMA.keys, (*_SCHEMA.words, "up", "down", *EXAMPLES))
BASES: list[dict[str, Any]] = [
    {"link": "up", "direction": "both", "words": "loss 5% mansd 4"},
    {"link": "down", "words": ["delay", "10ms", "2ms"]},
    {
        "link": "up",
        "settings": {
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
SEEDS = [*EDITS, *(json.dumps(base).encode() for base in BASES)]
WORDS = [json.dumps(word).encode() for word in (*KNOWN.keys, *KNOWN.words)]


class _AtOnce:
    """A command queue that runs commands at once, in this thread."""

    def __init__(self) -> None:
        self.relay = FakeRelay("up", "down")

    @property
    def links(self) -> list[str]:
        return [spec.name for spec in self.relay.specs]

    def change(self, link: str, directions: Any, settings: LinkSettings) -> None:
        for direction in directions:
            self.relay.change(link, direction, settings)

    def snapshot(self) -> Any:
        return SimpleNamespace(links=self.relay.report())


def one_input(data: bytes) -> None:
    if data[:1] == b"\0":
        choices = Choices(data[1:])
        base = json.loads(json.dumps(choices.one(BASES)))
        if "words" in base and choices.flag():
            base["words"] = sentence(choices)
        data = damaged(choices, json.dumps(edited(choices, base, KNOWN)).encode())
    commands = _AtOnce()
    server = ControlServer("test", commands)  # type: ignore[arg-type]
    before = dict(commands.relay.settings)
    query = Query("netem/test/change", data)
    server._reply(query, server._change)  # type: ignore[arg-type]
    assert query.answered == 1
    if query.error is not None:
        assert "an error of the emulator's own" not in query.error
        assert query.error.isprintable()
        assert commands.relay.settings == before, "a refused request changed settings"
    else:
        for link in json.loads(query.replies[0])["links"]:
            for direction in DIRECTIONS:
                settings = LinkSettings.model_validate_json(json.dumps(link[direction]["settings"]))
                assert settings == commands.relay.settings[link["name"], direction]
