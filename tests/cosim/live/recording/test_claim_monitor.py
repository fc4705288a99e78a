"""The monitor of several loops during a run, against the monitor of each loop alone."""

from typing import Any

import numpy as np
import pytest

from cosim.analysis.claims.condition_reader import AssumptionMonitor
from cosim.live.recording.claim_monitor import MOST_CHECKED, ClaimMonitor, Finding
from cosim.record.run_record import RecordedRun
from cosim.simulation.virtual_time import simulate_loops
from noack.core.clock import NS_PER_S
from noack.scenario.resolution import tables_of
from noack.scenario.scenario import phases_ns
from noack.scenario.scenario_file import validate
from tests.helpers.rows_of_loops import live_rows

Content = dict[str, Any]


@pytest.fixture
def content(content: Content) -> Content:
    """Three loops behind a slow link, which breaks assumptions on delay; one diverges."""
    content["horizon_s"] = 6.0
    content["plant"] |= {"rate_hz": 50.0}
    content["controller"] = {"rate_hz": 50.0}
    content["trigger"] = {"policy": "periodic", "period_s": 0.1}
    content["network"] |= {"impairments": [{"kind": "rate", "rate_bps": 20_000, "queue": 4}]}
    content["certificate"] = {"network_delay_s": 0.001}
    wild = {"draw": "given", "A": [[3.0, 0.0], [0.0, 3.0]], "B": [[0.0], [0.0]]}
    content["loops"] = [{"name": "good", "count": 2}, {"name": "wild", "plant": wild}]
    return content


def found_by(monitor: ClaimMonitor, run: RecordedRun) -> list[Finding]:
    findings: list[Finding] = []
    for table, rows in live_rows(run):
        monitor.take(table, rows)
        findings += monitor.advance()
    return findings + monitor.end()


def test_each_loop_is_checked_as_by_its_own_monitor(content: Content) -> None:
    run = simulate_loops(validate(content, "here"))
    scenario = run.network.scenario
    stopped = ClaimMonitor(scenario)
    stopped.stop("telemetry is missing")
    assert {finding.notice.level for finding in found_by(stopped, run)} == {"diverges"}
    findings = found_by(ClaimMonitor(scenario), run)
    voids = 0
    for number, (record, phase_ns) in enumerate(zip(run.loops, phases_ns(scenario), strict=True)):
        alone = AssumptionMonitor(record.scenario)
        for table in tables_of(record.scenario):
            alone.take(table, record[table])
        own = [
            finding for finding in findings if finding.notice[1:4:2] in (("void", number), ("late", number))
        ]
        expected = alone.end()
        assert {finding.notice.text.split(": ", 1)[1].split(",")[0][:24] for finding in own} == {
            violation.text.split(",")[0][:24] for violation in expected
        }
        for finding in own:
            at_s = (finding.notice.t_ns + phase_ns) / NS_PER_S
            name = record.scenario.name
            what = {"void": "void (assumption violated)", "late": "later than allowed"}
            assert finding.text.startswith(f"{name}: {what[finding.notice.level]} from {at_s:.3f} s on")
        voids += len(own)
    assert voids > 0
    at_once = ClaimMonitor(scenario)
    for table, rows in live_rows(run):
        at_once.take(table, rows)
    times_ns = [finding.notice.t_ns for finding in at_once.end()]
    assert times_ns == sorted(times_ns)


def test_a_diverging_loop_is_named_once_also_among_many(content: Content) -> None:
    for many in (False, True):
        if many:
            content["loops"][0]["count"] = MOST_CHECKED
            content["horizon_s"] = 4.0
            del content["network"]["impairments"]
        run = simulate_loops(validate(content, "here"))
        monitor = ClaimMonitor(run.network.scenario)
        assert (monitor.stopped is not None) == many
        (only,) = (finding for finding in found_by(monitor, run) if finding.notice.level == "diverges")
        assert only.text.startswith("wild: diverges from ")
        assert only.notice.loop == len(run.loops) - 1
        x = run.loops[-1]["plant_step"]
        index = np.searchsorted(x["t_ns"], only.notice.t_ns)
        early = np.linalg.norm(x["x"][x["t_ns"] < run.network.scenario.timing.horizon_ns / 10], axis=1)
        assert np.linalg.norm(x["x"][index]) > 1000 * early.max() >= np.linalg.norm(x["x"][index - 1])
