"""Without numba, the plain engine is used."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.netem.control.processes import address_in, read_until, udp_socket

HIDING = """
import importlib.util, sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "numba":
            raise ModuleNotFoundError(name, name="numba")
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *more: None if name == "numba" else found(name, *more)
sys.meta_path.insert(0, Hidden())
from netem.__main__ import main
sys.exit(main())
"""


def started(*arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", HIDING, "--listen", "127.0.0.1:0", *arguments],
        stderr=subprocess.PIPE,
    )


def test_the_plain_engine_relays() -> None:
    with udp_socket() as server:
        to = f"127.0.0.1:{server.getsockname()[1]}"
        with started("--to", to, "delay 1ms") as process:
            assert process.stderr is not None
            text = read_until(process.stderr.fileno(), lambda text: address_in(text) is not None)
            with udp_socket(address_in(text)) as client:
                client.send(b"hello")
                assert server.recv(10) == b"hello"
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0


@pytest.mark.parametrize(
    ("option", "says"),
    [
        ("--capture", "--capture: needs numba, which is not installed"),
        ("--engine=batched", "the batched engine needs numba, which is not installed; "),
    ],
)
def test_options_that_need_numba_name_it(option: str, says: str, tmp_path: Path) -> None:
    file = [str(tmp_path / "x.pcapng")] if option == "--capture" else []
    with started("--to", "127.0.0.1:9", option, *file) as process:
        _, error = process.communicate(timeout=60)
        assert process.returncode == 2
    assert error.decode().startswith(f"noack netem: {says}")
    assert error.count(b"\n") == 1
