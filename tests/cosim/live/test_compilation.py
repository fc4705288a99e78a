"""What is compiled before a run with many loops."""

from typing import Any

import pytest

from cosim.live import compilation
from noack.config.scenario_file import validate


@pytest.mark.parametrize(
    ("count", "spawn", "compiled"),
    [(20, ("netem", "plant"), 1), (19, ("netem",), 0), (20, ("plant",), 0)],
)
def test_the_emulator_of_many_loops_is_compiled_before_the_run(
    content: dict[str, Any], monkeypatch: pytest.MonkeyPatch,
    count: int, spawn: tuple[str, ...], compiled: int,
) -> None:  # fmt: skip
    calls: list[str] = []
    monkeypatch.setattr(compilation, "prepare", lambda roles, run: None)
    monkeypatch.setattr(compilation, "has_peer_sockets", lambda: True)
    monkeypatch.setattr(compilation, "kept_pump", lambda: None)
    monkeypatch.setattr(compilation, "compiled_pump", lambda: calls.append("pump"))
    content["loops"] = [{"name": "a", "count": count}]
    compilation.compile_for(validate(content, ""), spawn)
    assert len(calls) == compiled
