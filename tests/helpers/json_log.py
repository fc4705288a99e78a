"""The objects of a log as JSON Lines."""

import json
from typing import Any

Object = dict[str, Any]


def objects(text: str) -> list[Object]:
    """Return the objects of a log, each of which has the common keys."""
    entries = [json.loads(line) for line in text.splitlines()]
    for entry in entries:
        assert {"time", "level", "source", "message"} <= entry.keys()
        assert entry["time"].endswith("Z")
    return entries
