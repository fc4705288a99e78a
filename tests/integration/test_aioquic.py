"""aioquic's own tests of clients and servers pass through lossy links.

``.ci/run`` installs aioquic into ``.cache/aioquic``, from ``requirements-aioquic.lock``, and unpacks its
source distribution, which has the tests, beside it. They run unchanged: each client sends to the emulator
instead of to the server.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.live_runs import PATIENCE_S

pytestmark = [pytest.mark.system]
ROOT = Path(__file__).parents[2]
INSTALLED = ROOT / ".cache" / "aioquic"
SOURCES = ROOT / ".cache" / "aioquic-1.7.2"
WORDS = "loss 20% mansd 4"
LEFT_OUT = {
    "test_connect_and_serve_with_packet_loss": "loses datagrams itself, by a generator without a seed",
    "test_connect_local_port": "its fixed port 3456 may be in use",
    "test_connect_local_port_bind": "has no server",
    "test_connect_timeout": "has no server",
    "test_connect_timeout_no_wait_connected": "has no server",
    "test_wait_connected_twice": "has no server",
    "test_combined_key": "sends nothing",
    "test_server_receives_garbage": "calls the server's function; nothing is sent",
    "test_server_does_not_reply_to_version_negotiation_packet": "calls the server's function",
}
"""Tests of aioquic that do not run here, and why."""
PROGRAM = f'''
import contextlib
import importlib
import os

from netem.lossy_udp import LossyUdp

Direct = importlib.import_module("tests.test_asyncio").HighLevelTest
SEED = int(os.environ["NOACK_SEED"])


class HighLevelTest(Direct):
    @contextlib.asynccontextmanager
    async def run_server(self, configuration=None, host="::", **options):
        own, any_host = ("::1", "::") if ":" in host else ("127.0.0.1", "127.0.0.1")
        async with super().run_server(configuration, host, **options) as port:
            words = "{WORDS}"
            async with LossyUdp((own, port), words, reverse=words, seed=SEED, listen=(any_host, 0)) as link:
                yield link.address[1]
                assert max(link.forward["longest_loss_burst"], link.reverse["longest_loss_burst"]) <= 4
                print(link)


del Direct
'''


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.deep)])
def test_connections_bear_what_the_guarantee_allows(tmp_path: Path, seed: int) -> None:
    if not (INSTALLED.exists() and SOURCES.exists()):
        pytest.skip("aioquic is not in .cache; .ci/run fetches it")
    (tmp_path / "test_through_losses.py").write_text(PROGRAM)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    environment = os.environ | {
        "NOACK_SEED": str(seed),
        "PYTHONPATH": os.pathsep.join(map(str, (INSTALLED, SOURCES, ROOT))),
    }
    left_out = " and ".join(f"not {name}" for name in LEFT_OUT)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", left_out, tmp_path],
        cwd=tmp_path, env=environment, capture_output=True, text=True, check=False, timeout=8 * PATIENCE_S,
    )  # fmt: skip
    again = f"the same losses again: pytest {Path(__file__).relative_to(ROOT)} -k {seed}"
    assert done.returncode == 0, f"{done.stdout}\n{again}"
    assert "22 passed" in done.stdout
