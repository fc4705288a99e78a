"""Messages to the coordinator: join requests, ends and progress from any sender on the plane."""

import json
from typing import Any
from unittest.mock import patch

from cosim.live import coordinator
from noack.protocol.topology import ROLES
from tests.fuzz.choices import Choices
from tests.fuzz.edits import Vocabulary, edited
from tests.fuzz.parsers.ticket import _TICKET
from tests.fuzz.plane import FakePlane, Query, Sample
from tests.fuzz.tables import damaged

PASS = _TICKET.admission_pass
HELLO = {"pid": 1, "instance": "one", "address": ["127.0.0.1", 47001], "admission_pass": PASS}
PROGRESS = {
    "t_s": 0.0, "events": 0, "deliveries": 0, "longest_loss_burst": 0, "x_norm": None, "live": None,
}  # fmt: skip
KNOWN = Vocabulary((*HELLO, *PROGRESS), ("127.0.0.1", "", *ROLES))


def one_input(data: bytes) -> None:
    choices = Choices(data)
    plane = FakePlane()
    with patch.object(coordinator, "ControlPlane", lambda *_, **__: plane):
        barrier = coordinator.Coordinator(_TICKET)
    queries: dict[str, list[Query]] = {}
    admissions: list[Query] = []
    for _ in range(choices.below(12)):
        role = choices.one([*ROLES, "nobody", ""])
        match choices.below(6):
            case 0:
                plane.put("ended", Sample(f"noack/0/ended/{role}/one", _bytes(choices, "gone")))
            case 1:
                plane.put("progress", Sample("noack/0/progress", _bytes(choices, PROGRESS)))
                progress = barrier.progress()
                assert progress is None or progress.fields().keys() >= PROGRESS.keys()
            case 2 | 3:
                query = Query(f"noack/0/admit/{role}", _bytes(choices, HELLO))
                admissions.append(query)
                plane.put("admit", query)
            case _:
                query = Query(f"noack/0/join/{role}", _bytes(choices, HELLO))
                queries.setdefault(role, []).append(query)
                plane.put("join", query)
        barrier.poll()
    for role, asked in queries.items():
        if barrier.epoch_ns is not None or role not in ROLES:
            # A new join request replaces the sender's previous one.
            assert _is_over(asked[-1]), "a join request has no answer"
    assert all(query.answered == 1 for query in admissions), "an admission request has no answer"
    for answer in plane.answers:
        for host, port in answer.fields().get("addresses", {}).values():
            assert isinstance(host, str)
            assert 0 < port <= 65_535
    barrier.stop("the end")
    assert all(_is_over(asked[-1]) for asked in queries.values())


def _is_over(query: Query) -> bool:
    return query.answered > 0 or query.dismissed


def _bytes(choices: Choices, content: Any) -> bytes | None:
    if choices.flag():
        return json.dumps(content).encode()
    if choices.below(8) == 1:
        return None
    return damaged(choices, json.dumps(edited(choices, content, KNOWN)).encode())
