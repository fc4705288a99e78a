"""Run descriptors, and messages to the coordinator: join requests, ends, progress, changes."""

import fcntl
import json
import os
from typing import Any
from unittest.mock import patch

from cosim.live.coordination import coordinator
from netem.core.clock import RunClock
from netem.core.errors import PeerError
from netem.core.private_folder import open_private
from netem.core.toml_file import json_schema
from noack.protocol.roles import ROLES
from noack.runtime import active_runs, run_descriptor
from noack.runtime.control_messages import ChangeAnnouncement, ChangeReply, ChangeRequest, parse_message
from noack.scenario.parameter_changes import ChangeSchedule, settings_bytes, settings_of
from noack.scenario.resolution import ResolvedRun
from noack.scenario.runtime_parameters import SHORT
from noack.scenario.scenario import Scenario
from tests.fuzz.edits import Choices, Vocabulary, damaged, edited, vocabulary
from tests.fuzz.harness import refusal, workspace
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.helpers.run_descriptors import RUN_DESCRIPTOR

DESCRIPTOR: dict[str, Any] = json.loads(RUN_DESCRIPTOR.model_dump_json())
_SCENARIO = vocabulary(json_schema(Scenario))
DESCRIPTOR_KNOWN = Vocabulary((*DESCRIPTOR, *_SCENARIO.keys), (*_SCENARIO.words, "00" * 31, "0g"))
SEEDS = [json.dumps(DESCRIPTOR).encode()]
WORDS = [json.dumps(word).encode() for word in DESCRIPTOR]


def descriptor_input(choices: Choices) -> None:
    """A run descriptor is refused, or is valid and survives JSON."""
    if choices.below(4):
        data = json.dumps(edited(choices, DESCRIPTOR, DESCRIPTOR_KNOWN)).encode()
    else:
        data = choices.near(SEEDS, WORDS)
    with refusal("not a valid run descriptor"):
        descriptor = run_descriptor.parse_descriptor(data.decode("utf-8", "replace"))
        assert run_descriptor.parse_descriptor(descriptor.model_dump_json()) == descriptor
        assert len(descriptor.key) == 32
        assert 0 <= descriptor.run_id < 2**64
        assert isinstance(descriptor.run_dir, str)
        assert isinstance(descriptor.launched, bool)


HELLO = {"pid": 1, "instance": "one", "address": ["127.0.0.1", 47001]}
PROGRESS = {
    "t_s": 0.0, "events": 0, "deliveries": 0, "longest_loss_burst": 0, "x_norm": None, "live": None,
}  # fmt: skip
BARRIER_KNOWN = Vocabulary((*HELLO, *PROGRESS), ("127.0.0.1", "", *ROLES))


def barrier_input(choices: Choices) -> None:
    """The coordinator takes any messages before the start; each request has one answer."""
    plane = FakePlane()
    with patch.object(coordinator, "ControlPlane", lambda *_, **__: plane):
        barrier = coordinator.Coordinator(RUN_DESCRIPTOR, ResolvedRun(RUN_DESCRIPTOR.scenario))
    queries: dict[str, list[Query]] = {}
    admissions: list[Query] = []
    for _ in range(choices.below(12)):
        role = choices.choose([*ROLES, "nobody", ""])
        match choices.below(6):
            case 0:
                plane.put("ended", Sample(f"noack/0/ended/{role}/one", _barrier_bytes(choices, "gone")))
            case 1:
                plane.put("progress", Sample("noack/0/progress", _barrier_bytes(choices, PROGRESS)))
                progress = barrier.progress()
                assert progress is None or progress.fields().keys() >= PROGRESS.keys()
            case 2 | 3:
                query = Query(f"noack/0/admit/{role}", _barrier_bytes(choices, HELLO))
                admissions.append(query)
                plane.put("admit", query)
            case _:
                query = Query(f"noack/0/join/{role}", _barrier_bytes(choices, HELLO))
                queries.setdefault(role, []).append(query)
                plane.put("join", query)
        barrier.poll()
    for role, role_queries in queries.items():
        if barrier.epoch_ns is not None or role not in ROLES:
            # A new join request replaces the sender's previous one.
            assert _is_over(role_queries[-1]), "a join request has no answer"
    assert all(query.answered == 1 for query in admissions), "an admission request has no answer"
    for answer in plane.answers:
        for host, port in answer.fields().get("addresses", {}).values():
            assert isinstance(host, str)
            assert 0 < port <= 65_535
    barrier.stop("the end")
    assert all(_is_over(role_queries[-1]) for role_queries in queries.values())


def _is_over(query: Query) -> bool:
    return query.answered > 0 or query.dismissed


def _barrier_bytes(choices: Choices, content: Any) -> bytes | None:
    if choices.flag():
        return json.dumps(content).encode()
    if choices.below(8) == 1:
        return None
    return damaged(choices, json.dumps(edited(choices, content, BARRIER_KNOWN)).encode())


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
CHANGES_KNOWN = Vocabulary(
    (*ANNOUNCED, *ANSWER, *RUN, *SHORT.values(), *_SCENARIO.keys), (*SHORT, *_SCENARIO.words)
)


def changes_input(choices: Choices) -> None:
    """Requests, announcements and answers about changes are refused, or can be applied."""
    match choices.below(4):
        case 0:
            _request(_changes_bytes(choices, {"settings": SETTINGS}))
        case 1:
            _announce(_changes_bytes(choices, ANNOUNCED))
        case 2:
            with refusal("not a valid change reply"):
                assert isinstance(parse_message(ChangeReply, _changes_bytes(choices, ANSWER)).run_dir, str)
        case _:
            _find(_changes_bytes(choices, RUN))


def _request(content: bytes) -> None:
    """The coordinator replies, and every process can apply the announced changes."""
    plane = FakePlane()
    with patch.object(coordinator, "ControlPlane", lambda *_, **__: plane):
        centre = coordinator.Coordinator(RUN_DESCRIPTOR, ResolvedRun(RUN_DESCRIPTOR.scenario))
    centre._clock = RunClock(0, 1.0, lambda: 0)
    query = Query("noack/0/runtime_parameters", content)
    plane.put("runtime_parameters", query)
    centre.poll()
    assert query.answered == 1
    assert query.error is None or query.error.strip()
    for announced in plane.announced:
        announcement = parse_message(ChangeAnnouncement, json.dumps(announced))
        ChangeSchedule(RUN_DESCRIPTOR.scenario).announce("t", announcement.change, 0, 0, -1)
    try:
        settings = parse_message(ChangeRequest, content).settings
    except PeerError:
        assert not plane.announced
    else:
        assert len(plane.announced) <= bool(settings)


def _announce(content: bytes) -> None:
    """A process applies the change, or refuses it in one line and stays unchanged."""
    with refusal("not a valid change announcement"):
        announcement = parse_message(ChangeAnnouncement, content)
        schedule = ChangeSchedule(RUN_DESCRIPTOR.scenario)
        with refusal(("the change", "a change"), lines=True):
            schedule.announce("t", announcement.change, 0, 0, -1)
            assert settings_of(settings_bytes(announcement.settings)) == announcement.settings
            return
        assert schedule.last is RUN_DESCRIPTOR.scenario


def _find(data: bytes) -> None:
    with patch.dict(os.environ, {"XDG_RUNTIME_DIR": str(workspace())}):
        with open_private("runs", create=True) as folder:
            path = folder.path / "up.json"
        path.write_bytes(data)
        with path.open() as lock:  # locked as by the launcher
            fcntl.flock(lock, fcntl.LOCK_EX)
            with refusal(str(path)):
                run = active_runs.find_run()
                assert all(isinstance(field, str) for field in run if field is not None)


def _changes_bytes(choices: Choices, content: Any) -> bytes:
    whole, data = choices.flag(), json.dumps(edited(choices, content, CHANGES_KNOWN)).encode()
    return data if whole else damaged(choices, data)


PARSERS = {
    "run_descriptor": descriptor_input,
    "barrier": barrier_input,
    "changes": changes_input,
}
