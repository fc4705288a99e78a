"""The fork server: processes that it starts are children of the launcher, and end as others do."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import psutil
import pytest

from cosim.live.processes.fork_server import ForkedProcess, ForkServer, fork_server
from noack.core.errors import ExitStatus, MachineError
from tests.helpers.waiting import wait_for

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the fork server is for Linux")
PLANT = "plant_server.__main__"


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    with closing(ForkServer()) as server:
        yield server


@contextmanager
def started(server: ForkServer, folder: Path, *arguments: str) -> Iterator[ForkedProcess]:
    with (folder / "log").open("a") as log:
        process = server.start(PLANT, arguments, log)
    with process.stdin:
        yield process
    process.kill()
    process.wait()


def test_the_standard_input_of_a_process_ends_with_the_launcher(server: ForkServer, tmp_path: Path) -> None:
    """No other process, and not the server, may hold a process's standard input open."""
    with ExitStack() as stack:
        processes = [stack.enter_context(started(server, tmp_path)) for _ in range(3)]
        for process in processes:
            process.stdin.close()
            assert process.wait() == ExitStatus.CALLER  # an empty run descriptor


def test_a_process_is_a_child_in_a_session_of_its_own(server: ForkServer, tmp_path: Path) -> None:
    with started(server, tmp_path) as process:
        assert psutil.Process(process.pid).ppid() == os.getpid()
        wait_for(lambda: os.getsid(process.pid) == process.pid)  # its first act
        assert process.poll() is None
        process.kill()
        assert process.wait() == -signal.SIGKILL
        process.kill()  # it has ended: another process may have its pid


_OF_ITSELF = """
import os, signal, sys
from contextlib import closing
from cosim.live.processes.fork_server import ForkServer
signal.signal(signal.SIGTERM, lambda *_: print("no"))
with closing(ForkServer(of_itself=True)) as server, open(sys.argv[1], "a") as log:
    process = server.start("plant_server.__main__", [], log)
    print(os.getsid(process.pid) == os.getsid(0), flush=True)
    process.stdin.write("no run descriptor\\n")
    process.stdin.close()
    print(process.wait(), type(server._process).__name__, "NOACK_DESCRIPTOR_ON_STDIN" in os.environ)
"""


def test_a_command_forks_the_server_of_itself(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _OF_ITSELF, str(tmp_path / "log")]
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=150)
    assert result.stdout.splitlines() == ["False", f"{ExitStatus.CALLER} ForkedProcess False"]
    assert "not a valid run descriptor" in (tmp_path / "log").read_text()


@pytest.mark.parametrize(
    ("before", "environment"),
    [("import threading, time; threading.Thread(target=time.sleep, args=(3600,), daemon=True).start()",
      {}), ("", {"LC_ALL": "de_DE.ISO-8859-1", "PYTHONCOERCECLOCALE": "0", "PYTHONUTF8": "0"})],
)  # fmt: skip
def test_a_command_with_threads_or_another_encoding_starts_the_server_as_a_program(
    tmp_path: Path, before: str, environment: dict[str, str]
) -> None:
    command = [sys.executable, "-c", f"{before}\n{_OF_ITSELF}", str(tmp_path / "log")]
    result = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=150,
        env=os.environ | environment,
    )  # fmt: skip
    if environment and "ForkedProcess" in result.stdout:
        pytest.skip("the system has no such locale")
    assert f"{ExitStatus.CALLER} Popen" in result.stdout


def test_an_ignored_sigchld_hides_the_exit_status_only(tmp_path: Path) -> None:
    """The parent of a program may have ignored it, which is inherited."""
    usual = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        with closing(ForkServer()) as server, started(server, tmp_path, "--no") as process:
            assert process.wait() == ExitStatus.OK
    finally:
        signal.signal(signal.SIGCHLD, usual)
    assert "--no" in (tmp_path / "log").read_text()


def test_a_server_that_ends_or_cannot_be_started_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with closing(ForkServer()) as server:
        server._socket.close()  # as if the launcher had ended
        assert server._process.wait() == ExitStatus.OK
    with closing(ForkServer()) as server:
        server._process.kill()
        server._process.wait()
        with (
            pytest.raises(OSError, match=r"^the fork server ended"),
            started(server, tmp_path),
        ):
            pass
    monkeypatch.setattr("sys.executable", "/nowhere/python")
    with pytest.raises(MachineError, match="fork server cannot be started"), fork_server():
        pass
