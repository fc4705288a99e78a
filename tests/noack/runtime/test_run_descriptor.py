"""Run descriptors: errors without the key, one per session."""

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest

from netem.core.errors import CallerError
from netem.core.private_folder import private_folder
from noack.runtime.run_descriptor import (
    descriptor_file,
    find_descriptor,
    new_access,
    new_descriptor,
    parse_descriptor,
)
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate

KEY = "ab" * 32


@pytest.fixture
def fields(content: dict[str, Any]) -> dict[str, Any]:
    scenario = resolve(validate(content, "small"))
    descriptor = new_descriptor(new_access(Path("run"), launched=True), scenario)
    return descriptor.model_copy(update={"key": bytes.fromhex(KEY)}).model_dump(mode="json")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("run_id", -1), ("run_id", 2**64), ("run_id", "7"), ("key", KEY[:-2]), ("key", KEY + "00"),
        ("key", KEY.replace("a", "g")), ("key", f"{KEY} "), ("key", [KEY]), ("key", {KEY: KEY}),
        ("run_dir", 3), ("launched", 1), ("launched", "yes"),
        ("scenario", None), ("scenario", {}), ("more", 0),
    ],
)  # fmt: skip
def test_an_invalid_descriptor_gives_one_line_without_the_key(
    fields: dict[str, Any], key: str, value: object
) -> None:
    with pytest.raises(CallerError) as caught:
        parse_descriptor(json.dumps(fields | {key: value}))
    line = str(caught.value)
    assert line.startswith(f"not a valid run descriptor: {key}")
    assert "\n" not in line
    assert KEY[:8] not in line


@pytest.mark.parametrize("left_behind", [False, True])
def test_exactly_one_of_many_concurrent_runs_opens_a_session(
    fields: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left_behind: bool
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    descriptor, at_once = parse_descriptor(json.dumps(fields)), 8
    together = Barrier(at_once)
    if left_behind:  # left by a process that was killed
        with descriptor_file(descriptor, "lab") as path:
            text = path.read_text()
        path.write_text(text)

    def opened(number: int, stack: ExitStack) -> str:
        together.wait()
        try:
            stack.enter_context(descriptor_file(descriptor.model_copy(update={"run_id": number}), "lab"))
        except CallerError as error:
            return str(error)
        return ""

    with ExitStack() as stack, ThreadPoolExecutor(at_once) as pool:
        errors = list(pool.map(lambda number: opened(number, stack), range(at_once)))
        winner = errors.index("")
        refusal = "session 'lab': another run is open in it; choose --session NAME"
        assert sorted(errors) == ["", *[refusal] * (at_once - 1)]
        descriptor = find_descriptor("lab")
        assert descriptor is not None
        assert descriptor.run_id == winner
    assert list(private_folder().iterdir()) == []
