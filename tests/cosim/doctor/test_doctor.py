"""From measured values to findings, independent of the machine."""

import io
import json
import re
import socket
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import Result

from cosim.doctor.findings import MachineFinding, MachineVerdict, find_all, findings_document, worst
from cosim.doctor.machine_measures import Buffer, Disk, Lateness, MachineFacts, RunRequirements, lateness
from netem.output.terminal_writer import print_document
from tests.helpers.command_line import invoke

WANTED = RunRequirements(
    name="loop", duration_s=20.0, period_ns=2_000_000, allowance_ns=4_000_000, realtime=True,
    fifo_priority=50, spin_us=0.0, ports={"plant": 47001, "netem": 47005},
)  # fmt: skip
PROMPT = Lateness(1000, 30.0, 100.0, 300.0, 0)
ALL = ("sched_fifo", "memory_lock", "timer_slack", "affinity", "cpu_dma_latency")
IDEAL = MachineFacts(
    cores=4, cores_online=4, load=0.1, governor="performance",
    settings=dict.fromkeys(ALL, "applied"),
    lateness=PROMPT, buffer=Buffer(10_000, 8_388_608, 4_194_304),
    ports_taken=(), control=1e-3, disk=Disk("runs", 10**10, 10**7, 5e8), runtime_folder=None,
    display=True, viewer="0.41.0",
)  # fmt: skip


def about(title: str, required: RunRequirements = WANTED, **changed: Any) -> MachineFinding:
    """The first finding of a kind that is not good, or the first one if all are good."""
    findings = find_all(replace(IDEAL, **changed), required)
    of_kind = [finding for finding in findings if finding.what.startswith(title)]
    return next((finding for finding in of_kind if finding.verdict is not MachineVerdict.GOOD), of_kind[0])


def test_a_machine_without_limits_is_good() -> None:
    findings = find_all(IDEAL, WANTED)
    assert worst(findings) is MachineVerdict.GOOD
    assert not [finding for finding in findings if finding.remedy]


@pytest.mark.parametrize(("what", "changed", "verdict"), [
    ("cores", {"cores": 1}, MachineVerdict.LIMITED),
    ("cores", {"load": 7.0}, MachineVerdict.LIMITED),
    ("cores", {"governor": "powersave"}, MachineVerdict.LIMITED),
    ("cores", {"load": None, "governor": None}, MachineVerdict.GOOD),
    ("real-time", {"settings": {"sched_fifo": "not permitted: no"}}, MachineVerdict.LIMITED),
    ("wake-ups", {"lateness": "it timed out"}, MachineVerdict.LIMITED),
    # Certificates allow it, but a step of the plant is over before.
    ("wake-ups", {"lateness": Lateness(1000, 30.0, 79_600.0, 90_000.0, 0)}, MachineVerdict.LIMITED),
    ("receive buffer", {"buffer": Buffer(256, 212_992, 212_992)}, MachineVerdict.LIMITED),
    ("receive buffer", {"buffer": "nothing"}, MachineVerdict.BAD),
    ("ports", {"ports_taken": ["plant: UDP port 47001 is taken"]}, MachineVerdict.BAD),
    ("control plane", {"control": "no answer within 2 s"}, MachineVerdict.BAD),
    ("disk", {"disk": "runs: cannot be written: no space left"}, MachineVerdict.BAD),
    ("disk", {"disk": Disk("runs", 10**6, 10**7, 5e8)}, MachineVerdict.BAD),
    ("disk", {"disk": Disk("runs", 10**10, 10**7, 1e6)}, MachineVerdict.LIMITED),
    ("runtime folder", {"runtime_folder": "/run/x: must be yours"}, MachineVerdict.LIMITED),
    ("viewer", {"display": False}, MachineVerdict.LIMITED),
    ("viewer", {"viewer": None}, MachineVerdict.LIMITED),
])  # fmt: skip
def test_each_finding_has_a_verdict_and_a_remedy(
    what: str, changed: dict[str, Any], verdict: MachineVerdict
) -> None:
    finding = about(what, **changed)
    assert finding.verdict is verdict
    if verdict is not MachineVerdict.GOOD:
        assert finding.means
        assert finding.remedy or isinstance(next(iter(changed.values())), str)
        assert worst(find_all(replace(IDEAL, **changed), WANTED)) is verdict


def test_lateness_is_compared_with_the_allowance_of_the_certificates() -> None:
    late = Lateness(1000, 50.0, 3000.0, 9000.0, 4)
    finding = about("wake-ups", lateness=late)
    assert finding.verdict is MachineVerdict.LIMITED
    not_realtime = replace(WANTED, realtime=False)  # what is not used does not matter
    settings = {"sched_fifo": "not permitted: Operation not permitted"}
    assert about("real-time", not_realtime, settings=settings).verdict is MachineVerdict.GOOD
    # 4 of 1000 at 500 Hz: one every 250 steps of 2 ms
    assert "4 of them (0.4 %) beyond the 4 ms that loop's certificates allow" in finding.means
    assert "one every 0.5 s of a run of 20 s" in finding.means
    assert "certificate.late_periods" in finding.remedy


def test_every_finding_is_documented() -> None:
    text = (Path(__file__).parents[3] / "docs/command-line.md").read_text()
    rows = re.findall(r"^\| `([^`]+)` \|", text.partition("| finding |")[2], re.MULTILINE)
    names = [row.removesuffix(" ...").removesuffix(" of").removesuffix(":") for row in rows]
    titles = {finding.what for finding in find_all(IDEAL, WANTED)}
    assert all(any(title.startswith(name) for name in names) for title in titles)
    assert all(any(title.startswith(name) for title in titles) for name in names)


def test_the_text_has_each_finding_with_its_meaning_and_remedy() -> None:
    machine = replace(IDEAL, cores=1, ports_taken=("plant: UDP port 47001 is taken",))
    results = find_all(machine, WANTED)
    document = findings_document(machine, WANTED, results)
    print_document(Console(file=(file := io.StringIO()), width=200), document)
    *lines, last = [line.strip() for line in file.getvalue().splitlines()]
    assert len(lines) == sum(1 + bool(finding.means) + bool(finding.remedy) for finding in results)
    place = lines.index("bad      ports of loop       plant: UDP port 47001 is taken")
    assert lines[place + 1 : place + 3] == [
        "loop cannot run on its configured ports",
        "→ stop the program that uses the port, or `--set ports={}`",
    ]
    assert last == "this machine, for loop: not ready: no run is possible"


def test_lateness_statistics_are_those_of_the_sample() -> None:
    statistics = lateness(range(0, 101_000, 1000), 98_500)  # 0 to 100 µs
    assert statistics == Lateness(101, 50.0, 99.0, 100.0, 2)
    assert isinstance(lateness([], 1), str)


def doctor(*arguments: str) -> Result:
    return invoke("doctor", *arguments)


def test_every_check_gives_a_finding_and_a_taken_port_makes_a_run_impossible(
    tmp_path: Path,
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as endpoint:
        endpoint.bind(("127.0.0.1", 0))
        port = endpoint.getsockname()[1]
        ports = ("--set", f"ports={{plant={port}}}")
        result = doctor("--seconds", "0.1", *ports, "--json", "--runs", str(tmp_path))
    document = json.loads(result.stdout)
    assert (result.exit_code, document["verdict"]) == (1, "bad")
    (finding,) = [entry for entry in document["findings"] if entry["what"].startswith("ports of")]
    assert finding["verdict"] == "bad"
    assert str(port) in finding["found"]
    assert "already taken" in finding["found"]
    measured = document["measured"]
    assert measured["lateness"]["wakes"] > 0, measured
    assert measured["lateness"]["p50_us"] <= measured["lateness"]["max_us"]
    assert measured["buffer"]["datagrams"] > 100
    assert measured["control"] > 0
    assert measured["disk"]["write_bytes_per_s"] > 0
    assert set(measured["settings"]) >= {"sched_fifo", "memory_lock"}
    assert {entry["verdict"] for entry in document["findings"]} <= {"good", "limited", "bad"}
    assert not list(tmp_path.iterdir())
