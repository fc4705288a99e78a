"""Tickets: plain text or an edited valid file."""

import json
from pathlib import Path
from typing import Any

from noack.runtime import join_ticket
from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import validate
from noack.scenario.toml_file import json_schema
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.edits import Vocabulary, bases, edited, vocabulary
from tests.fuzz.harness import refusal

_TICKET = join_ticket.new_ticket(
    resolve(validate(bases("scenarios")[0], "base")), Path("run"),
    launched=True,
).model_copy(
    update={"run_id": 7, "key": bytes(32), "admission_pass": "0" * 32, "clock": "one"}
)  # fmt: skip
TICKET: dict[str, Any] = json.loads(_TICKET.model_dump_json())
_SCENARIO = vocabulary(json_schema(Scenario))
KNOWN = Vocabulary((*TICKET, *_SCENARIO.keys), (*_SCENARIO.words, "00" * 31, "0g"))
SEEDS = [json.dumps(TICKET).encode(), *EDITS]
WORDS = [json.dumps(word).encode() for word in TICKET]


def one_input(data: bytes) -> None:
    if data[:1] == b"\0":
        choices = Choices(data[1:])
        content = edited(choices, TICKET, KNOWN)
        data = json.dumps(content).encode()
    with refusal("not a valid ticket"):
        found = join_ticket.loads(data.decode("utf-8", "replace"))
        assert join_ticket.loads(found.model_dump_json()) == found
        assert len(found.key) == 32
        assert 0 <= found.run_id < 2**64
        assert isinstance(found.run_dir, str)
        assert isinstance(found.launched, bool)
