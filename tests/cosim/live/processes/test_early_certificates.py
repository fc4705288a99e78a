"""The certificates that a process computes while a run goes on."""

import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from cosim.analysis.claims.run_certificates import expected_certificates
from cosim.live.processes import early_certificates
from cosim.live.processes.early_certificates import EarlyCertificates, _compute
from cosim.record.run_record import resolved_run
from cosim.record.run_scenario import write_scenario
from noack.scenario.resolution import resolve_run
from tests.helpers.shipped import shipped
from tests.helpers.waiting import wait_for


def compute_at_usual_priority(run_dir: Path, sender: Connection) -> None:
    """For the process: on a busy machine, idle priority can get no time for minutes."""
    early_certificates.be_idle = lambda: None
    _compute(run_dir, sender)


def compute_for_days(run_dir: Path, sender: Connection) -> None:
    """For the process: it computes no certificate in the time of a run."""
    time.sleep(1e6)


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A run of three loops, of which two are equal."""
    scenario = shipped("shared_bottleneck", "certificate.prove=false")
    assert scenario.loops is not None
    loops = (scenario.loops[0].model_copy(update={"count": 2}), scenario.loops[1])
    write_scenario(resolve_run(scenario.model_copy(update={"loops": loops})), tmp_path)
    return tmp_path


def test_they_are_those_of_each_loop(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(early_certificates, "_compute", compute_at_usual_priority)
    loops = resolved_run(run_dir).loops
    with EarlyCertificates() as certificates:
        certificates.start(run_dir)
        wait_for(lambda: len(certificates.known) == len(loops))
    for number, loop in enumerate(loops):
        expected, known = expected_certificates(loop, len(loops)), certificates.known[number]
        assert expected is not None
        assert known is not None
        for one, other in zip(expected, known, strict=True):
            assert one.certificate.to_json() == other.certificate.to_json()
            tables = [None if each.document is None else each.document.table for each in (one, other)]
            assert tables[0] == tables[1]


def test_the_end_of_a_run_does_not_wait_for_them(run_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(early_certificates, "_compute", compute_for_days)
    with EarlyCertificates() as certificates:
        certificates.start(run_dir)
    assert certificates.known == {}


def test_a_process_that_is_killed_costs_what_it_has_not_computed(
    run_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(early_certificates, "_compute", compute_for_days)
    with EarlyCertificates() as certificates:
        certificates.start(run_dir)
        assert certificates._process is not None
        assert certificates._thread is not None
        certificates._process.kill()
        wait_for(lambda: not certificates._thread.is_alive())
    assert certificates.known == {}
