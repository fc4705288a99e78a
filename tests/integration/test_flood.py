"""Send as many datagrams as possible to every port of a run: the loop continues."""

import subprocess
import sys
from collections.abc import Callable

import pytest

from cosim.record.run_record import load_record
from noack.protocol.topology import LOOP_ROLES
from noack.runtime.udp_sockets import SHED
from tests.integration.conftest import Running, settings
from tests.integration.test_faults import wait_recording

FLOOD_S = 1.5
needs_shield = pytest.mark.skipif(sys.platform != "linux", reason="there is a shield on Linux only")


@needs_shield
def test_a_run_survives_a_flood_and_logs_it(start: Callable[..., Running]) -> None:
    running = start(*settings(horizon_s=8.0))
    wait_recording(running)
    ports = [running.udp_port(role) for role in LOOP_ROLES]
    subprocess.run(
        [
            sys.executable, "-m", "benchmarks._flood", "--seconds", str(FLOOD_S),
            "--ports", *map(str, ports),
        ],
        check=True, stdout=subprocess.DEVNULL, timeout=60,
    )  # fmt: skip
    finished = running.finish()
    assert finished.status == 0, finished.stderr
    assert finished.summary["exit"]["reason"] == "horizon"
    record = load_record(finished.run_dir)
    begun = {line["process"] for line in record.notices if line["text"].startswith("flood:")}
    ended = {line["process"] for line in record.notices if line["text"].startswith("the flood is")}
    assert begun == ended == set(LOOP_ROLES)
    for role in LOOP_ROLES:
        channel = record.reports[role]["channel"]
        assert channel["rejected"][SHED] > 1000
        assert channel["lost_in_kernel"] == 0
        assert len(channel["received_from"]) <= 17
    assert finished.summary["rejected_datagrams"].keys() == set(LOOP_ROLES)
    assert finished.summary["missing_samples"] == 0
    assert finished.summary["replay"]["bit_exact"]
    assert finished.summary["identity_residual_max"] < 1e-11
    assert [c for c in finished.summary["claims"] if c["verdict"] == "violated"] == []
