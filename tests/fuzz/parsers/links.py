"""Files of links: plain text or, after a zero byte, an edited valid file."""

import json
import socket
from collections.abc import Callable
from typing import Any
from unittest.mock import patch

import tomli_w

from netem.tc_words import json_schema, load_links, settings_of, text_of
from noack.impairments.link_settings import LinkSettings
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.edits import NAMED, edited, quoted, vocabulary, write_named
from tests.fuzz.harness import refusal, workspace
from tests.fuzz.parsers.words import WORDS as TOKENS
from tests.fuzz.parsers.words import sentence
from tests.netem.any_settings import words_can_say

_SCHEMA = vocabulary(json_schema(), dates=True)
KNOWN = _SCHEMA._replace(
    words=(
        *_SCHEMA.words, *NAMED, ":9000", "[::1]:9000", "127.0.0.1:9001", ":70000", "nowhere:1",
        "::", "loss 5% mansd 4", "delay 10ms 2ms", "loss gemodel 1% 10%", "rate 1mbit", "up",
        "down",
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
SEEDS = [tomli_w.dumps(BASE).encode(), *EDITS]
WORDS = (*quoted(KNOWN), *TOKENS)
_LOOK_UP: Callable[..., Any] = socket.getaddrinfo


def numeric(host: str, port: int, family: int, kind: int) -> Any:
    """Resolve an address without network access."""
    flags = socket.AI_NUMERICHOST
    return _LOOK_UP(host, port, family=family, type=kind, flags=flags)


def one_input(data: bytes) -> None:
    if data[:1] == b"\0":
        choices = Choices(data[1:])
        content: dict[str, Any] = json.loads(json.dumps(BASE))
        if choices.flag():
            content["link"][0]["words"] = sentence(choices)
        data = tomli_w.dumps(edited(choices, content, KNOWN)).encode()
    path = write_named(workspace(), "links.toml", data)
    with refusal(str(path), lines=True), patch("noack.runtime.address.socket.getaddrinfo", numeric):
        for spec in load_links(path):
            for settings in (spec.forward, spec.reverse):
                assert LinkSettings.model_validate_json(settings.model_dump_json()) == settings
                if words_can_say(settings):
                    assert settings_of(text_of(settings)) == settings
