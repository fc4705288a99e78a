"""Tickets and session files of emulators: plain text or an edited valid file."""

import fcntl
import json
import os
from pathlib import Path
from typing import Any
from unittest.mock import patch

from netem.control import emulator_session
from noack.config.resolution import resolve
from noack.config.scenario import Scenario
from noack.config.scenario_file import validate
from noack.config.toml_file import json_schema
from noack.runtime import join_ticket
from noack.runtime.private_folder import open_private
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.edits import Vocabulary, bases, edited, vocabulary
from tests.fuzz.harness import refusal, workspace

_TICKET = join_ticket.new_ticket(
    resolve(validate(bases("scenarios")[0], "base")), "tcp/127.0.0.1:7447", Path("run"),
    launched=True,
).model_copy(update={"run_id": 7, "key": bytes(32)})  # fmt: skip
TICKET: dict[str, Any] = json.loads(_TICKET.model_dump_json())
SESSION = {"name": "up", "endpoint": "tcp/127.0.0.1:7447", "token": "00" * 32}
_SCENARIO = vocabulary(json_schema(Scenario))
KNOWN = Vocabulary(
    (*TICKET, *SESSION, *_SCENARIO.keys), (*_SCENARIO.words, "00" * 31, "0g", "tcp/", "tcp/x:y")
)
SEEDS = [json.dumps(TICKET).encode(), json.dumps(SESSION).encode(), *EDITS]
WORDS = [json.dumps(word).encode() for word in (*TICKET, *SESSION)]


def one_input(data: bytes) -> None:
    if data[:1] == b"\0":
        choices = Choices(data[1:])
        content = edited(choices, choices.one([TICKET, SESSION]), KNOWN)
        data = json.dumps(content).encode()
    with refusal("not a valid ticket"):
        found = join_ticket.loads(data.decode("utf-8", "replace"))
        assert join_ticket.loads(found.model_dump_json()) == found
        assert len(found.key) == 32
        assert 0 <= found.run_id < 2**64
        assert isinstance(found.endpoint, str)
        assert isinstance(found.run_dir, str)
        assert isinstance(found.launched, bool)
    with patch.dict(os.environ, {"XDG_RUNTIME_DIR": str(workspace())}):
        with open_private("netem", create=True) as folder:
            path = folder.path / "up.json"
        path.write_bytes(data)
        with path.open() as lock:  # locked as by the emulator
            fcntl.flock(lock, fcntl.LOCK_EX)
            with refusal("emulator 'up'"):
                one = emulator_session.find("up")
                assert all(isinstance(field, str) for field in one)
