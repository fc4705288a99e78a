"""A run descriptor, and messages that are none."""

from pathlib import Path

from noack.runtime.run_descriptor import RunDescriptor, new_access, new_descriptor
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.fuzz.edits import bases

RUN_DESCRIPTOR: RunDescriptor = new_descriptor(
    new_access(Path("run"), launched=True), resolve(validate(bases("scenarios")[0], "base"))
).model_copy(
    update={"run_id": 7, "key": bytes(32), "clock": "one"}
)  # fmt: skip
JUNK: list[bytes | None] = [
    None, b"", b"{", b"\xff", b"[]", b"{}", b"null", b'{"rows": 1}', b"[" * 100_000,
    b'{"pid": 1, "address": ["127.0.0.1", 0]}', b'{"pid": 1, "address": null}',
]  # fmt: skip
"""Messages that no process may send."""
