"""A folder of credentials as another host reads it: one line for each mistake."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from netem.core.errors import CallerError, PeerError
from noack.runtime.connections.credentials import own_host, read_credentials
from tests.helpers.run_descriptors import RUN_DESCRIPTOR

REMOTE = RUN_DESCRIPTOR.model_copy(
    update={"remote": ("127.0.0.1", 7447), "credentials_for": "sensor", "run_dir": "/elsewhere/runs/one"}
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "sensor"
    made.mkdir()
    for name in ("ca.pem", "certificate.pem", "private_key.pem"):
        (made / name).write_text("PEM")
    (made / "run.json").write_text(REMOTE.model_dump_json())
    for path in made.iterdir():
        path.chmod(0o600)
    return made


def test_rows_stay_in_a_folder_of_the_run_name(folder: Path, tmp_path: Path) -> None:
    descriptor = read_credentials(folder, "sensor", tmp_path / "kept")
    assert descriptor.run_dir == str(tmp_path / "kept" / "one")
    assert descriptor.host == "127.0.0.1"
    assert descriptor.credentials == str(folder)
    with pytest.raises(CallerError, match=r"rows could not be kept there: .* is not a folder"):
        read_credentials(folder, "sensor", folder / "run.json" / "runs")
    assert not (tmp_path / "kept").exists()


def _fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path, 0o600)


@pytest.mark.parametrize(
    ("name", "spoil", "reason"),
    [
        ("ca.pem", Path.unlink, "cannot be read: No such file or directory; copy the whole folder"),
        (
            "private_key.pem", lambda path: path.chmod(0o640),
            "other users can read or change it; make it yours alone: chmod 600 ",
        ),
        ("run.json", lambda path: path.write_bytes(b"\xff\xfe"), "not of `noack record --listen`: "),
        ("run.json", lambda path: path.write_text("{"), "not a valid run descriptor: "),
        ("run.json", _fifo, "cannot be read: not a regular file"),
        ("run.json", lambda path: os.truncate(path, 10**9), "larger than 64 MiB"),
        (
            "run.json",
            lambda path: path.write_text(REMOTE.model_dump_json().replace("/elsewhere/runs/one", "runs/..")),
            "its run directory has no name",
        ),
        (
            "run.json", lambda path: path.write_text(RUN_DESCRIPTOR.model_dump_json()),
            "these credentials are of no role, not of sensor",
        ),
    ],
)  # fmt: skip
def test_a_spoiled_file_is_refused_in_one_line(
    folder: Path, name: str, spoil: Callable[[Path], None], reason: str
) -> None:
    spoil(folder / name)
    with pytest.raises(CallerError, match=reason) as caught:
        read_credentials(folder, "sensor", folder)
    assert str(caught.value).startswith(str(folder))
    assert "\n" not in str(caught.value)
    assert "0" * 32 not in str(caught.value)  # the key


def test_the_folder_of_all_roles_is_answered_with_that_of_the_role(folder: Path, tmp_path: Path) -> None:
    """It said: run.json cannot be read; copy the whole folder."""
    whole = tmp_path / "whole"
    shutil.copytree(folder, whole / "sensor")
    with pytest.raises(CallerError) as caught:
        read_credentials(whole, "sensor", folder)
    assert str(caught.value) == f"{whole}: has the credentials of all roles; give {whole / 'sensor'}"


def test_the_own_address_is_that_of_the_route() -> None:
    assert own_host(("127.0.0.1", 9)) == "127.0.0.1"
    with pytest.raises(PeerError, match=r"cannot reach 255\.255\.255\.255:9"):
        own_host(("255.255.255.255", 9))
