"""The folder of credentials: whose files it replaces, and what it deletes at the end."""

import json
import os
import shutil
import stat
import sys
from pathlib import Path

import pytest

from cosim.live.coordination.credentials_folder import MARK, credentials_folder
from netem.core.errors import CallerError

if sys.platform == "win32":
    pytest.skip("runs across hosts need Linux", allow_module_level=True)

FILES = {"plant/ca.pem": b"A", "plant/run.json": b"{}", "sensor/ca.pem": b"A"}


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def leave(folder: Path) -> None:
    """Leave the folder of a run that was killed."""
    with credentials_folder(folder, FILES):
        shutil.copytree(folder, folder.with_name("copy"))
    folder.with_name("copy").rename(folder)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "credentials"


def test_the_folder_is_private_and_goes_with_the_run(folder: Path) -> None:
    with credentials_folder(folder, FILES):
        assert content(folder).items() >= FILES.items()
        for path in (folder, *folder.rglob("*")):
            assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600)
    assert [*folder.parent.iterdir()] == []


@pytest.mark.parametrize(
    "names", [[], ["notes.txt"], ["a/b"], ["plant/ca.pem"], ["plant/notes.txt", "sensor/x"]]
)
def test_a_folder_of_the_user_is_not_replaced(folder: Path, names: list[str]) -> None:
    """Also an empty one, and one that has folders of the same names."""
    folder.mkdir()
    for name in names:
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"mine")
    with pytest.raises(
        CallerError, match="exists, and is not a folder of credentials; give another by --credentials"
    ):
        credentials_folder(folder, FILES).__enter__()
    assert content(folder) == dict.fromkeys(names, b"mine")
    assert [*folder.parent.iterdir()] == [folder]


@pytest.mark.parametrize("target", ["elsewhere", "missing"])
def test_a_link_is_not_replaced(folder: Path, target: str) -> None:
    leave(folder.with_name("elsewhere"))
    folder.symlink_to(target)
    with pytest.raises(CallerError, match="exists, and is not a folder of credentials"):
        credentials_folder(folder, FILES).__enter__()
    assert content(folder.with_name("elsewhere")).items() >= FILES.items()


def test_what_a_user_adds_or_changes_during_the_run_stays(folder: Path) -> None:
    with credentials_folder(folder, FILES):
        (folder / "notes.txt").write_text("mine")
        (folder / "plant" / "key.txt").write_text("mine")
        (folder / "plant" / "run.json").write_text("changed")
        (folder / "empty").mkdir()
    mine = {"notes.txt": b"mine", "plant/key.txt": b"mine", "plant/run.json": b"changed"}
    assert content(folder) == mine
    assert sorted(path.name for path in folder.iterdir()) == ["empty", "notes.txt", "plant"]


def test_another_folder_in_its_place_stays(folder: Path) -> None:
    """Also a copy, which has the same mark."""
    with credentials_folder(folder, FILES):
        folder.rename(folder.with_name("moved"))
        shutil.copytree(folder.with_name("moved"), folder)
    assert content(folder).items() >= FILES.items()
    assert content(folder.with_name("moved")).items() >= FILES.items()


def test_two_open_runs_do_not_share_a_folder(folder: Path) -> None:
    with credentials_folder(folder, FILES):
        before = content(folder)
        with pytest.raises(
            CallerError, match="has the credentials of an open run; give another by --credentials"
        ):
            credentials_folder(folder, {"plant/ca.pem": b"B"}).__enter__()
        assert content(folder) == before
    assert not folder.exists()


def test_the_folder_of_a_killed_run_is_replaced(folder: Path) -> None:
    leave(folder)
    with credentials_folder(folder, {"netem/ca.pem": b"B"}):
        assert {*content(folder)} == {"netem/ca.pem", MARK}
    assert not folder.exists()


@pytest.mark.parametrize("name", ["notes.txt", "plant/notes.txt", "plant/run.json"])
def test_the_folder_of_a_killed_run_stays_if_it_has_files_of_the_user(folder: Path, name: str) -> None:
    leave(folder)
    (folder / name).write_text("mine")
    before = content(folder)
    with pytest.raises(
        CallerError, match=f"{name} is not of `noack record`; move it, or give another folder"
    ):
        credentials_folder(folder, FILES).__enter__()
    assert content(folder) == before


@pytest.mark.parametrize("mark", [b"", b"[]", b"{", b"\xff"])
def test_a_damaged_mark_is_refused(folder: Path, mark: bytes) -> None:
    leave(folder)
    (folder / MARK).write_bytes(mark)
    with pytest.raises(CallerError, match="damaged; remove the folder, or give another"):
        credentials_folder(folder, FILES).__enter__()
    assert content(folder) == FILES | {MARK: mark}


def test_a_mark_leads_to_no_file_elsewhere(folder: Path) -> None:
    leave(folder)
    mine = folder.with_name("mine.txt")
    mine.write_bytes(b"A")
    digest = json.loads((folder / MARK).read_bytes())["plant/ca.pem"]
    names = ["../mine.txt", str(mine), f"plant/{mine}", "plant/../../mine.txt", "plant/link", "link/mine.txt"]
    (folder / MARK).write_text(json.dumps(dict.fromkeys(names, digest)))
    (folder / "plant" / "link").symlink_to(mine)
    (folder / "link").symlink_to(folder.parent)
    with pytest.raises(CallerError, match="is not of `noack record`"):
        credentials_folder(folder, FILES).__enter__()
    assert mine.read_bytes() == b"A"


def test_a_folder_that_cannot_be_written_leaves_nothing(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fdopen", full)
    with pytest.raises(OSError, match="No space left"):
        credentials_folder(folder, FILES).__enter__()
    assert [*folder.parent.iterdir()] == []
