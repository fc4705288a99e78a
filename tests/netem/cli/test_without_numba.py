"""Without numba the emulator relays, but cannot write captures."""

import signal
import subprocess
import sys
from pathlib import Path

from tests.netem.control.processes import address_in, read_until, udp_socket

HIDING = """
import sys
class Hidden:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] == "numba":
            raise ModuleNotFoundError(name, name="numba")
sys.meta_path.insert(0, Hidden())
from netem.__main__ import main
link = ["--listen", "127.0.0.1:0", "--to", sys.argv[1]]
assert main([*link, "--capture", sys.argv[2]]) == 2
sys.exit(main([*link, "delay 1ms"]))
"""


def test_it_relays_and_the_capture_names_numba(tmp_path: Path) -> None:
    with udp_socket() as server:
        to, capture = f"127.0.0.1:{server.getsockname()[1]}", tmp_path / "x.pcapng"
        with subprocess.Popen(
            [sys.executable, "-c", HIDING, to, capture], stderr=subprocess.PIPE
        ) as process:
            assert process.stderr is not None
            text = read_until(process.stderr.fileno(), lambda text: address_in(text) is not None)
            with udp_socket(address_in(text)) as client:
                client.send(b"hello")
                assert server.recv(10) == b"hello"
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
    assert text.splitlines()[0] == "noack netem: --capture: needs numba, which is not installed"
