"""The file that places processes on other hosts."""

from pathlib import Path

import pytest

from cosim.live.remote_access import listening_for
from noack.core.errors import CallerError

ROBOT = '[controller]\nssh = "robot"\n'


@pytest.fixture
def ssh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = tmp_path / "bin" / "ssh"
    script.parent.mkdir()
    script.write_text("#!/bin/sh\n")
    script.chmod(0o755)
    monkeypatch.setenv("PATH", str(script.parent))


def written(folder: Path, text: str) -> Path:
    path = folder / "hosts.toml"
    path.write_text(text)
    return path


@pytest.mark.usefixtures("ssh")
def test_processes_without_a_table_stay_here(tmp_path: Path) -> None:
    found = listening_for(written(tmp_path, f'listen = "192.0.2.1:7400"\n{ROBOT}'))
    assert found.address == ("192.0.2.1", 7400)
    assert found.invitation is None
    assert {role: host.ssh for role, host in found.hosts.items()} == {"controller": "robot"}


@pytest.mark.usefixtures("ssh")
@pytest.mark.parametrize(
    ("text", "line"),
    [
        (ROBOT, "hosts.toml: listen: missing"),
        ('listen = "192.0.2.1"\n', "no process is on another host"),
        (f'listen = "0.0.0.0"\n{ROBOT}', "hosts.toml: listen: 0.0.0.0 is not an address"),
        (
            f'listen = "192.0.2.1"\n[recorder]\nssh = "robot"\n{ROBOT}',
            "the keys here are controller",
        ),
        ('listen = "192.0.2.1"\n[plant]\nssh = "-oProxyCommand=reboot"\n', "plant.ssh"),
        ('listen = "192.0.2.1"\n[plant]\nssh = "a b"\n', "plant.ssh"),
        ('listen = "192.0.2.1"\nplant = "robot"\n', "plant"),
        ('listen = "192.0.2.1"\n[plant]\nssh = "a\\u0000b"\n', "has a control character"),
        (f'listen = "192.0.2.1"\n{ROBOT}command = "a\\u0000"\n', "controller.command"),
        (f'listen = "192.0.2.1"\n{ROBOT}runs = "a\\nb"\n', "controller.runs"),
    ],
)
def test_a_mistake_gives_one_line(tmp_path: Path, text: str, line: str) -> None:
    with pytest.raises(CallerError) as caught:
        listening_for(written(tmp_path, text))
    assert line in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_without_an_ssh_client_the_message_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(CallerError, match="no ssh client is installed"):
        listening_for(written(tmp_path, f'listen = "192.0.2.1"\n{ROBOT}'))
