"""Invitations: who can read them, and what this host makes of them."""

import json
import os
import stat
from collections.abc import Callable
from pathlib import Path

import pytest

from noack.core.errors import CallerError, PeerError
from noack.runtime.join_ticket import (
    RemoteAccess,
    Ticket,
    invitation_file,
    own_host,
    read_invitation,
    write_invitation,
)
from tests.fuzz.parsers.ticket import _TICKET

REMOTE = RemoteAccess(
    host="127.0.0.1", port=7000, coordinator="A", certificate="C", private_key="K",
    valid_until="2030-01-01T00:00:00+00:00",
)  # fmt: skip
INVITED: Ticket = _TICKET.model_copy(update={"remote": REMOTE, "run_dir": "/elsewhere/runs/one"})


def test_an_invitation_is_for_its_owner_only_and_is_read_again(tmp_path: Path) -> None:
    path = tmp_path / "invitation.json"
    path.write_text("an older one")
    path.chmod(0o644)
    write_invitation(path, INVITED)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    found = read_invitation(path, tmp_path / "kept")
    expected = {"run_dir": str(tmp_path / "kept" / "one"), "host": "127.0.0.1"}
    assert found == INVITED.model_copy(update=expected)
    assert [one.name for one in tmp_path.iterdir()] == ["invitation.json"]


def _absent(path: Path) -> None:
    path.unlink()


def _open_to_others(path: Path) -> None:
    path.chmod(0o640)


def _cut(path: Path) -> None:
    path.write_text(path.read_text()[:100])


def _no_text(path: Path) -> None:
    path.write_bytes(b"\xff\xfe")


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


def _too_large(path: Path) -> None:
    os.truncate(path, 10**9)


def _without_a_run(path: Path) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {"run_dir": "runs/.."}))


def _at_a_name(path: Path) -> None:
    content = json.loads(path.read_text())
    content["remote"]["host"] = "host.invalid"
    path.write_text(json.dumps(content))


def _of_this_host(path: Path) -> None:
    path.write_text(_TICKET.model_dump_json())


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (_absent, "cannot be read: No such file or directory"),
        (_open_to_others, "other users can read or change it; make it yours alone: chmod 600 "),
        (_cut, "not an invitation: not a valid ticket: "),
        (_no_text, "not an invitation: it is no text"),
        (_fifo, "cannot be read: not a regular file"),
        (_too_large, "not an invitation: larger than 64 MiB"),
        (_without_a_run, "not an invitation: its run directory has no name"),
        (_at_a_name, "not an invitation: not a valid ticket: "),
        (_of_this_host, "not an invitation, but a ticket for this host"),
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
    with pytest.raises(CallerError, match=r"rows could not be kept there: .* is no folder"):
        read_invitation(path, path / "runs")
    assert read_invitation(path, tmp_path / "no" / "folder" / "yet").run_dir.endswith("/yet/one")
    assert not (tmp_path / "no").exists()


def test_an_invitation_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="the invitation cannot be written"):
        write_invitation(tmp_path / "no_folder" / "invitation.json", INVITED)
    (tmp_path / "folder").mkdir()
    with pytest.raises(CallerError, match="the invitation cannot be written: not a regular file"):
        write_invitation(tmp_path / "folder", INVITED)
    assert [one.name for one in tmp_path.iterdir()] == ["folder"]  # no file with the keys is left


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


@pytest.mark.parametrize("spoil", [_absent, _fifo, lambda path: (path.unlink(), path.mkdir())])
def test_a_run_ends_whatever_became_of_its_invitation(
    tmp_path: Path, spoil: Callable[[Path], None]
) -> None:
    path = tmp_path / "invitation.json"
    with invitation_file(path, INVITED):
        spoil(path)


def test_the_own_address_is_that_of_the_route() -> None:
    assert own_host(("127.0.0.1", 9)) == "127.0.0.1"
    with pytest.raises(PeerError, match=r"cannot reach 255\.255\.255\.255:9"):
        own_host(("255.255.255.255", 9))
