"""Changes of settings: requests, the coordinator's announcements, and files of open runs."""

import fcntl
import json
import os
from typing import Any
from unittest.mock import patch

from cosim.live import coordinator
from noack.core.clock import RunClock
from noack.core.errors import PeerError
from noack.runtime import run_registry
from noack.runtime.control_messages import (
    ChangeAnnouncement,
    ChangeReply,
    ChangeRequest,
    parse_message,
)
from noack.runtime.private_folder import open_private
from noack.scenario.parameter_changes import (
    ChangeSchedule,
    settings_bytes,
    settings_of,
)
from noack.scenario.runtime_parameters import SHORT
from tests.fuzz.choices import Choices
from tests.fuzz.edits import Vocabulary, edited
from tests.fuzz.harness import refusal, workspace
from tests.fuzz.parsers.ticket import _SCENARIO, _TICKET
from tests.fuzz.plane import FakePlane, Query
from tests.fuzz.tables import damaged

SETTINGS: dict[str, Any] = {
    "network.loss.probability": 0.9,
    "network.loss": {"model": "bernoulli", "probability": 0.1},
    "network.mansd": 2,
    "trigger.beta": 0.3,
}
ANNOUNCED = {
    "number": 0, "t_ns": 10**9, "settings": SETTINGS, "requested_ns": 0, "requested_at": "now",
}  # fmt: skip
ANSWER = {
    "name": "x",
    "run_dir": "runs/x",
    "t_s": 0.5,
    "from_s": 0.7,
    "runtime_parameters": SETTINGS,
    "loops": {"x": SETTINGS},
    "changed_loops": ["x"],
}
RUN = {"name": "00", "run_dir": "runs/x", "session": None}
KNOWN = Vocabulary(
    (*ANNOUNCED, *ANSWER, *RUN, *SHORT.values(), *_SCENARIO.keys), (*SHORT, *_SCENARIO.words)
)


def one_input(data: bytes) -> None:
    choices = Choices(data)
    match choices.below(4):
        case 0:
            _request(_bytes(choices, {"settings": SETTINGS}))
        case 1:
            _announce(_bytes(choices, ANNOUNCED))
        case 2:
            with refusal("not a valid change reply"):
                assert isinstance(parse_message(ChangeReply, _bytes(choices, ANSWER)).run_dir, str)
        case _:
            _find(_bytes(choices, RUN))


def _request(content: bytes) -> None:
    """The coordinator replies, and every process can apply the announced changes."""
    plane = FakePlane()
    with patch.object(coordinator, "ControlPlane", lambda *_, **__: plane):
        centre = coordinator.Coordinator(_TICKET)
    centre._clock = RunClock(0, 1.0, lambda: 0)
    query = Query("noack/0/runtime_parameters", content)
    plane.put("runtime_parameters", query)
    centre.poll()
    assert query.answered == 1
    assert query.error is None or query.error.strip()
    for announced in plane.announced:
        one = parse_message(ChangeAnnouncement, json.dumps(announced))
        ChangeSchedule(_TICKET.scenario).announce("t", one.change, 0, 0, -1)
    try:
        settings = parse_message(ChangeRequest, content).settings
    except PeerError:
        assert not plane.announced
    else:
        assert len(plane.announced) <= bool(settings)


def _announce(content: bytes) -> None:
    """A process applies the change, or refuses it in one line and stays unchanged."""
    with refusal("not a valid change announcement"):
        one = parse_message(ChangeAnnouncement, content)
        schedule = ChangeSchedule(_TICKET.scenario)
        with refusal(("the change", "a change"), lines=True):
            schedule.announce("t", one.change, 0, 0, -1)
            assert settings_of(settings_bytes(one.settings)) == one.settings
            return
        assert schedule.last is _TICKET.scenario


def _find(data: bytes) -> None:
    with patch.dict(os.environ, {"XDG_RUNTIME_DIR": str(workspace())}):
        with open_private("runs", create=True) as folder:
            path = folder.path / "up.json"
        path.write_bytes(data)
        with path.open() as lock:  # locked as by the launcher
            fcntl.flock(lock, fcntl.LOCK_EX)
            with refusal(str(path)):
                run = run_registry.find()
                assert all(isinstance(field, str) for field in run if field is not None)


def _bytes(choices: Choices, content: Any) -> bytes:
    whole, data = choices.flag(), json.dumps(edited(choices, content, KNOWN)).encode()
    return data if whole else damaged(choices, data)
