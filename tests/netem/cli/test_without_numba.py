"""Without numba, the plain engine is used."""

import signal
import subprocess
import sys
from pathlib import Path

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
link = ["--listen", "127.0.0.1:0", "--to", sys.argv[1]]
assert main([*link, "--capture", sys.argv[2]]) == main([*link, "--engine=batched"]) == 2
sys.exit(main([*link, "delay 1ms"]))
"""


def test_the_plain_engine_relays_and_other_options_name_numba(tmp_path: Path) -> None:
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
    no_capture, no_engine, *_ = text.splitlines()
    assert no_capture == "noack netem: --capture: needs numba, which is not installed"
    message = "noack netem: the batched engine needs numba, which is not installed; "
    assert no_engine.startswith(message)
