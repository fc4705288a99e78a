import stat
from pathlib import Path

import pytest

from netem.control.control_server import find, published, running
from noack.core.errors import CallerError

LAB = "lab"


def test_a_session_is_found_while_it_lasts() -> None:
    assert running() == []
    with published(LAB) as path:
        assert running() == ["lab"]
        assert find("lab") == find(None) == LAB
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
        assert [file.name for file in path.parent.iterdir()] == ["lab.json"]
    assert running() == []
    assert list(path.parent.iterdir()) == []


def test_an_error_of_the_emulator_itself_is_not_taken_for_a_used_name() -> None:
    with pytest.raises(FileExistsError, match="capture"), published(LAB):
        raise FileExistsError("capture.pcapng")


@pytest.mark.parametrize("name", ["", "a/b", "../up", ".hidden", "x" * 65])
def test_unfit_names_are_refused(name: str) -> None:
    with pytest.raises(CallerError, match="use letters, digits"), published(name):
        pass


def test_an_unknown_name_gets_the_running_names() -> None:
    with pytest.raises(CallerError, match="no emulator accepts commands; start one"):
        find(None)
    with pytest.raises(CallerError, match="no emulator 'lab' accepts commands"):
        find("lab")
    with published(LAB), published("b"):
        with pytest.raises(CallerError, match=r"which emulator\? Running: b, lab"):
            find(None)
        with pytest.raises(CallerError, match="no emulator 'lba'; running: b, lab"):
            find("lba")


def test_a_folder_open_to_others_is_refused() -> None:
    with published(LAB) as path:
        pass
    path.parent.chmod(0o755)
    for use in (running, lambda: published(LAB).__enter__()):
        with pytest.raises(CallerError, match="closed to others"):
            use()


def test_a_file_replaced_by_another_emulator_is_not_removed(runtime_dir: Path) -> None:
    with published(LAB) as path:
        other = path.with_name("other")
        other.write_text("mine")
        other.replace(path)
    assert path.read_text() == "mine"
