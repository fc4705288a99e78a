"""A whole run with all impairments of the updates, live and simulated."""

import subprocess
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.output.run_tables import key_numbers
from cosim.record.run_record import RunRecord, load_record
from noack.protocol.record_tables import CONTROLLER_DELIVERY, NETEM_PACKET, NETEM_RELEASE, Fate
from noack.protocol.wire_format import read_header
from tests.integration.conftest import (
    PATIENCE_S,
    Finished,
    noack_command,
    run_scenario,
    settings,
)

MANSD = 2
IMPAIRMENTS = """[
    { kind = "delay", delay_s = 0.01, jitter_s = 0.01 },
    { kind = "reorder", probability = 0.2 },
    { kind = "duplicate", probability = 0.2 },
    { kind = "corrupt", probability = 0.2 },
]"""


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    values = {
        "horizon_s": 3.0,
        "speed": 2.0,
        "trigger__beta": 0.0003,  # an update about every 15 ms
        "network__mansd": MANSD,
        "network__loss__probability": 0.1,
    }
    return run_scenario(
        tmp_path_factory.mktemp("runs"),
        *settings(**values),
        *("--set", f"network.impairments={' '.join(IMPAIRMENTS.split())}"),
    )


@pytest.fixture(scope="module")
def live(finished: Finished) -> RunRecord:
    assert finished.status == 0, finished.stderr
    return load_record(finished.run_dir)


@pytest.fixture(scope="module")
def simulated(finished: Finished, tmp_path_factory: pytest.TempPathFactory) -> RunRecord:
    runs = tmp_path_factory.mktemp("simulated")
    done = subprocess.run(
        noack_command("simulate", str(finished.run_dir / "scenario.toml"), "--runs", str(runs)),
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return load_record((runs / "latest").resolve())


def sequences(rows: NDArray[Any]) -> list[int]:
    return [read_header(head.tobytes()).sequence for head in rows["head"]]


def test_the_run_completes_and_is_replayed_bit_for_bit(finished: Finished) -> None:
    summary = finished.summary
    assert finished.status == 0, finished.stderr
    assert summary["exit"] == {"status": 0, "reason": "horizon"}
    assert summary["replay"]["bit_exact"]
    assert summary["replay"]["complete"]
    assert summary["unintended_losses"] == 0
    assert summary["missing_samples"] == 0
    assert summary["longest_loss_burst"] <= MANSD
    assert "Traceback" not in finished.stderr
    logs = [log.read_text() for log in (finished.run_dir / "logs").iterdir()]
    assert not any("Traceback" in log for log in logs)


def test_the_table_lists_losses_by_cause(finished: Finished) -> None:
    rows = dict(key_numbers(finished.summary))
    causes = finished.summary["drops_by_cause"]
    assert {"dropped", "corrupted"} <= set(causes)
    assert sum(causes.values()) == finished.summary["drops"]
    for cause, number in causes.items():
        assert rows[f"  of these {cause.replace('_', ' ')}"] == str(number)


def test_claims_are_judged(finished: Finished) -> None:
    verdicts: dict[str, set[str]] = {}
    for claim in finished.summary["claims"]:
        verdicts.setdefault(claim["source"], set()).add(claim["verdict"])
    assert verdicts["(I1)"] == {"held"}
    assert "violated" not in verdicts["certificate"]  # void if the machine stalled too long


def test_every_impairment_occurs(live: RunRecord) -> None:
    packets, released = live[NETEM_PACKET], live[NETEM_RELEASE]
    assert len(packets) > 100
    assert {Fate.DELIVERED, Fate.DROPPED, Fate.FORCED, Fate.CORRUPTED} <= set(packets["fate"])
    assert released["copy"].any()
    assert released["stale"].any()


def test_forwarded_packets_reach_the_controller(finished: Finished, live: RunRecord) -> None:
    packets = live[NETEM_PACKET]
    left = int((packets["release_ns"] >= 0).sum() + (packets["copy_ns"] >= 0).sum())
    rejected = finished.summary["rejected_datagrams"]["controller"]
    assert rejected["stale"] > 0
    assert left == len(live[CONTROLLER_DELIVERY]) + sum(rejected.values())


def test_the_controller_never_misses_more_than_mansd(live: RunRecord) -> None:
    sent = sequences(live[NETEM_PACKET])
    assert sent == list(range(len(sent)))
    taken = live[CONTROLLER_DELIVERY]["sequence"]
    ends = np.concatenate([[-1], taken, [len(sent)]])
    assert np.diff(ends).max() - 1 <= MANSD
    assert live[CONTROLLER_DELIVERY]["dropouts"].max() == np.diff(ends[:-1]).max() - 1


def test_the_simulated_run_has_the_same_fates(live: RunRecord, simulated: RunRecord) -> None:
    count = min(len(live[NETEM_PACKET]), len(simulated[NETEM_PACKET]))
    assert count > 100
    # In the live run, updates are slightly later, so departures and reordering differ.
    for column in ("sequence", "flow", "fate", "consecutive_losses", "bit"):
        here, there = (record[NETEM_PACKET][column][:count] for record in (live, simulated))
        np.testing.assert_array_equal(here, there, column)
    copied = [record[NETEM_PACKET]["copy_ns"][:count] >= 0 for record in (live, simulated)]
    np.testing.assert_array_equal(*copied)
