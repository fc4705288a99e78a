"""Invitations and run descriptors: who can read them, errors without the key, one per session."""

import json
import os
import stat
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from threading import Barrier
from typing import Any

import pytest

from noack.core.errors import CallerError, PeerError
from noack.runtime.private_folder import private_folder
from noack.runtime.run_descriptor import (
    descriptor_file,
    find_descriptor,
    invitation_file,
    loads,
    new_descriptor,
    own_host,
    read_invitation,
    write_invitation,
)
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.helpers.run_descriptors import INVITED, RUN_DESCRIPTOR

INVITED_AS = INVITED.model_dump_json()


def test_an_invitation_is_for_its_owner_only_and_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "invitation.json"
    path.write_text("an older one")
    path.chmod(0o644)
    write_invitation(path, INVITED)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    descriptor = read_invitation(path, tmp_path / "kept")
    expected = {"run_dir": str(tmp_path / "kept" / "one"), "host": "127.0.0.1"}
    assert descriptor == INVITED.model_copy(update=expected)
    assert [path.name for path in tmp_path.iterdir()] == ["invitation.json"]


def _absent(path: Path) -> None:
    path.unlink()


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (_absent, "cannot be read: No such file or directory"),
        (
            lambda path: path.chmod(0o640),
            "other users can read or change it; make it yours alone: chmod 600 ",
        ),
        (lambda path: path.write_bytes(b"\xff\xfe"), "not an invitation: it is not text"),
        (lambda path: path.write_text("{"), "not an invitation: not a valid run descriptor: "),
        (_fifo, "cannot be read: not a regular file"),
        (lambda path: os.truncate(path, 10**9), "not an invitation: larger than 64 MiB"),
        (
            lambda path: path.write_text(INVITED_AS.replace("/elsewhere/runs/one", "runs/..")),
            "not an invitation: its run directory has no name",
        ),
        (
            lambda path: path.write_text(RUN_DESCRIPTOR.model_dump_json()),
            "not an invitation, but a run descriptor for this host",
        ),
    ],
)
def test_a_spoiled_invitation_is_refused_in_one_line(
    tmp_path: Path, spoil: Callable[[Path], None], reason: str
) -> None:
    path = tmp_path / "invitation.json"
    write_invitation(path, INVITED)
    spoil(path)
    with pytest.raises(CallerError, match=reason) as caught:
        read_invitation(path, tmp_path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_rows_must_have_a_place_before_a_process_joins(tmp_path: Path) -> None:
    path = tmp_path / "invitation.json"
    write_invitation(path, INVITED)
    with pytest.raises(CallerError, match=r"rows could not be kept there: .* is not a folder"):
        read_invitation(path, path / "runs")
    assert read_invitation(path, tmp_path / "no" / "folder" / "yet").run_dir.endswith("/yet/one")
    assert not (tmp_path / "no").exists()


def test_an_invitation_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="the invitation cannot be written"):
        write_invitation(tmp_path / "no_folder" / "invitation.json", INVITED)
    (tmp_path / "folder").mkdir()
    with pytest.raises(CallerError, match="the invitation cannot be written: not a regular file"):
        write_invitation(tmp_path / "folder", INVITED)
    assert [path.name for path in tmp_path.iterdir()] == ["folder"]  # no file with the keys is left


def test_a_run_removes_its_own_invitation_only(tmp_path: Path) -> None:
    path, other = tmp_path / "invitation.json", INVITED.model_copy(update={"run_id": 8})
    with invitation_file(path, INVITED):
        assert path.exists()
    assert not path.exists()
    with invitation_file(path, other):
        with invitation_file(path, INVITED):
            write_invitation(path, other)
        assert path.exists()
    assert not path.exists()


def test_the_own_address_is_that_of_the_route() -> None:
    assert own_host(("127.0.0.1", 9)) == "127.0.0.1"
    with pytest.raises(PeerError, match=r"cannot reach 255\.255\.255\.255:9"):
        own_host(("255.255.255.255", 9))


KEY = "ab" * 32


@pytest.fixture
def fields(content: dict[str, Any]) -> dict[str, Any]:
    scenario = resolve(validate(content, "small"))
    descriptor = new_descriptor(scenario, Path("run"), launched=True)
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
        loads(json.dumps(fields | {key: value}))
    line = str(caught.value)
    assert line.startswith(f"not a valid run descriptor: {key}")
    assert "\n" not in line
    assert KEY[:8] not in line


@pytest.mark.parametrize("left_behind", [False, True])
def test_exactly_one_of_many_concurrent_runs_opens_a_session(
    fields: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, left_behind: bool
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    descriptor, at_once = loads(json.dumps(fields)), 8
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
