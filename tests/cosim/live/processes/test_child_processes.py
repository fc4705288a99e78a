"""The processes of a run: forked from a command, or by Python's fork server; they end as others do."""

import json
import multiprocessing.forkserver
import multiprocessing.util
import os
import signal
import stat
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import pytest

from cosim.live.processes.child_processes import MODULES, ChildProcesses
from netem.core.errors import ExitStatus
from noack.protocol.roles import LOOP_ROLES
from tests.helpers.waiting import wait_for

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="live runs are for Linux")
_NO_DESCRIPTOR = "not a valid run descriptor"


@contextmanager
def started(folder: Path, *roles: str, fork: bool = False) -> Iterator[ChildProcesses]:
    (folder / "logs").mkdir(exist_ok=True)
    children = ChildProcesses(folder, roles, fork=fork)
    try:
        children.start()
        yield children
    finally:
        children.end()


def no_failure(_role: str) -> None:
    return None


@pytest.mark.parametrize("fork", [False, True])
def test_the_standard_input_of_a_process_ends_with_the_launcher(tmp_path: Path, fork: bool) -> None:
    """No other process, and not the server, may hold a process's standard input open."""
    with started(tmp_path, *LOOP_ROLES, fork=fork) as children:
        assert {*children.running()} == {*LOOP_ROLES}
        for role in LOOP_ROLES:
            children._inputs[role].close()
            children._children[role].join()
            assert children._children[role].exitcode == ExitStatus.CALLER  # an empty run descriptor
        failures = children.failures(no_failure)
    assert {*failures} == {*LOOP_ROLES}
    assert all(_NO_DESCRIPTOR in reason for _, reason in failures.values())


def test_a_process_has_a_session_of_its_own_and_its_death_a_name(tmp_path: Path) -> None:
    with started(tmp_path, "plant") as children:
        pid = children._children["plant"].pid
        wait_for(lambda: os.getsid(pid) == pid)  # its first act
        assert children.failures(no_failure) == {}
        os.kill(pid, signal.SIGSTOP)
        wait_for(lambda: children.stopped() == {"plant"})
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda: not children.running())
        assert children.failures(no_failure)["plant"].reason == "plant died: killed by SIGKILL"


_COMMAND = """
import os, signal, sys
signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # as a parent may have done, which is inherited
from pathlib import Path
from cosim.live.processes.child_processes import ChildProcesses
signal.signal(signal.SIGTERM, lambda *_: print("no"))
children = ChildProcesses(Path(sys.argv[1]), ["plant", "sensor"], fork=FORK)
children.start()
for stdin in children._inputs.values():
    stdin.close()
plant, sensor = children._children.values()
plant.join()
sensor.join()
print(plant.exitcode, type(plant).__name__, "NOACK_DESCRIPTOR_ON_STDIN" in os.environ)
children.end()
"""


def output_of(program: str, folder: Path, environment: Mapping[str, str] = {}) -> str:
    """What a program prints that starts a plant and a sensor, which get no run descriptor."""
    (folder / "logs").mkdir(exist_ok=True)
    command = [sys.executable, "-c", program, str(folder)]
    result = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=150,
        env=os.environ | {"OPENBLAS_NUM_THREADS": "1"} | environment,
    )  # fmt: skip
    assert result.stderr == ""
    assert _NO_DESCRIPTOR in (folder / "logs/plant.log").read_text()
    return result.stdout


_OF_COMMAND, _OF_PROGRAM = (_COMMAND.replace("FORK", str(fork)) for fork in (True, False))
_THREAD = "import threading, time; threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()\n"
_LATIN = {"LC_ALL": "de_DE.ISO-8859-1", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"}


def test_processes_of_a_command_are_forked_from_it(tmp_path: Path) -> None:
    assert output_of(_OF_COMMAND, tmp_path) == f"{ExitStatus.CALLER.value} ForkProcess False\n"


@pytest.mark.parametrize(
    ("program", "environment"),
    [(_OF_PROGRAM, {}), (_THREAD + _OF_COMMAND, {}), (_OF_COMMAND, _LATIN)],
)
def test_a_program_or_a_command_with_threads_or_another_encoding_uses_the_fork_server(
    tmp_path: Path, program: str, environment: dict[str, str]
) -> None:
    output = output_of(program, tmp_path, environment)
    if environment and "ForkProcess" in output:
        pytest.skip("the system has no such locale")
    assert output == f"{ExitStatus.CALLER.value} ForkServerProcess False\n"


@pytest.mark.parametrize("program", [_OF_COMMAND, _OF_PROGRAM])
def test_processes_start_when_the_standard_streams_are_closed(tmp_path: Path, program: str) -> None:
    (tmp_path / "logs").mkdir()
    command = ["sh", "-c", '"$0" -c "$1" "$2" <&- >&- 2>&-', sys.executable, program, str(tmp_path)]
    assert subprocess.run(command, timeout=150).returncode == 0
    for role in ("plant", "sensor"):
        assert _NO_DESCRIPTOR in (tmp_path / f"logs/{role}.log").read_text()


@pytest.mark.parametrize("fork", [False, True])
def test_a_process_has_the_environment_and_the_folder_of_its_launcher(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fork: bool
) -> None:
    """Also one of a fork server that was started before."""
    monkeypatch.setitem(MODULES, "plant", "tests.helpers.shown_process")
    for name in ("NOACK_TEST_FIRST", "NOACK_TEST_SECOND"):
        monkeypatch.setenv(name, "1")
        (folder := tmp_path / name).mkdir()
        monkeypatch.chdir(folder)
        with started(folder, "plant", fork=fork) as children:
            wait_for(lambda: not children.running())
        shown = json.loads((folder / "logs/plant.log").read_text())
        assert shown["folder"] == str(folder)
        assert {key for key in shown["environment"] if key.startswith("NOACK_TEST")} == {name}
        monkeypatch.delenv(name)


def test_another_user_cannot_reach_the_fork_server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(multiprocessing.util, "abstract_sockets_supported", True)
    with started(tmp_path, "plant"):
        address = multiprocessing.forkserver._forkserver._forkserver_address  # type: ignore[attr-defined]
        assert stat.S_IMODE(Path(address).parent.stat().st_mode) == 0o700
    assert not multiprocessing.util.abstract_sockets_supported
