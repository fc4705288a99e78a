"""The runtime folder in a world-writable place: other users get no access.

Some tests imitate the other user's actions; tests that need a second user id are skipped without
root.
"""

import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cosim.doctor.machine_measures import _runtime_folder
from netem.control import control_server as emulator_session
from noack.core.errors import CallerError
from noack.runtime import run_registry
from noack.runtime.join_ticket import Ticket, find_ticket, new_ticket, published
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.attacks.other_user import NOBODY, needs_root

OWN = f"noack-{os.getuid()}"
EMULATOR = "lab"

_swaps: list[Callable[[str], None]] = []
"""Actions of the other user as this process opens a file; an audit hook cannot be removed."""


def _as_a_file_is_opened(event: str, details: tuple[Any, ...]) -> None:
    if event == "open" and _swaps and str(details[0]).rpartition("/")[2].startswith("default."):
        _swaps.pop()(str(details[0]))


sys.addaudithook(_as_a_file_is_opened)


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder for temporary files, used without XDG_RUNTIME_DIR."""
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


@pytest.fixture
def ticket(content: dict[str, Any]) -> Ticket:
    scenario = resolve(validate(content, "small"))
    return new_ticket(scenario, Path("run"), launched=False)


def join() -> Ticket:
    ticket = find_ticket("default")
    assert ticket is not None
    return ticket


Use = Callable[[Ticket], object]
USES: dict[str, Use] = {
    "publish a ticket": lambda ticket: published(ticket, "default").__enter__(),
    "join a run": lambda _: join(),
    "publish a run": lambda ticket: run_registry.published(ticket, None).__enter__(),
    "find a run": lambda _: run_registry.find(),
    "publish an emulator": lambda _: emulator_session.published(EMULATOR).__enter__(),
    "list emulators": lambda _: emulator_session.running(),
}


INSIDE = [
    ("runs", "publish a run"), ("runs", "find a run"),
    ("netem", "publish an emulator"), ("netem", "list emulators"),
]  # fmt: skip


@pytest.mark.parametrize(("place", "use"), [*INSIDE, *(("", use) for use in USES)])
def test_a_symbolic_link_instead_of_a_folder_is_refused(
    place: str, use: str, shared: Path, ticket: Ticket
) -> None:
    """Even a link to this user's own folder: its owner can change the target at any time."""
    own = shared / "own"
    for folder in (own, own / "runs", own / "netem", shared / OWN):
        folder.mkdir(mode=0o700)
    if not place:
        (shared / OWN).rmdir()
    (own / "default.json").write_text(ticket.model_dump_json())
    (shared / OWN / place).symlink_to(own)
    with pytest.raises(CallerError, match="closed to others"):
        USES[use](ticket)
    if not place:
        assert "closed to others" in str(_runtime_folder())  # the doctor reports it
    assert [file.name for file in own.rglob("*") if file.is_file()] == ["default.json"]


def test_a_ticket_is_not_written_into_a_folder_swapped_in_meanwhile(
    shared: Path, ticket: Ticket
) -> None:
    """The swap happens after the folder is checked and before the file is opened."""
    theirs = shared / "theirs"
    theirs.mkdir()

    def swap(_: str) -> None:
        (shared / OWN).rename(shared / "away")
        (shared / OWN).symlink_to(theirs)
        (theirs / f"default.{os.getpid()}").touch(mode=0o666)  # theirs if opened, not created

    with published(ticket, "other"):
        pass  # creates the folder, as an earlier run does
    _swaps.append(swap)
    with published(ticket, "default"):
        assert not _swaps
        assert not any(file.read_text() for file in theirs.iterdir())


def test_a_ticket_is_not_read_from_a_folder_swapped_in_meanwhile(
    shared: Path, ticket: Ticket, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even if the other user swaps the folder back, noack does not use the planted ticket."""
    theirs, away = shared / "theirs", shared / "away"
    theirs.mkdir()
    (theirs / "default.json").write_text(
        ticket.model_copy(update={"run_dir": "theirs"}).model_dump_json()
    )

    def swap(_: str) -> None:
        (shared / OWN).rename(away)
        (shared / OWN).symlink_to(theirs)

    real = Path.stat

    def swap_back(path: Path, **options: Any) -> os.stat_result:
        if path == shared / OWN and away.exists():
            path.unlink()
            away.rename(path)
        return real(path, **options)

    with published(ticket, "default"):
        _swaps.append(swap)
        monkeypatch.setattr(Path, "stat", swap_back)
        assert join().run_dir == ticket.run_dir
    assert not _swaps


@needs_root
@pytest.mark.parametrize("theirs", ["folder", "file"])
def test_a_file_of_another_user_is_not_read(theirs: str, shared: Path, ticket: Ticket) -> None:
    with published(ticket, "default") as path:
        os.chown(path if theirs == "file" else path.parent, NOBODY, NOBODY)
        with pytest.raises(CallerError, match="of yours"):
            join()


def test_only_regular_files_are_read(shared: Path) -> None:
    """A named pipe would block its reader."""
    (shared / OWN).mkdir(mode=0o700)
    os.mkfifo(shared / OWN / "default.json")
    with pytest.raises(CallerError, match="file of yours"):
        join()


def test_a_run_without_a_usable_folder_is_refused(shared: Path) -> None:
    assert find_ticket("default") is None
    with pytest.raises(CallerError, match="no run is active"):
        run_registry.find()
    assert emulator_session.running() == []
    assert not (shared / OWN).exists()
