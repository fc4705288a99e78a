"""Findings on a machine, from its measurements: their meaning for a run, remedies, a table."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from enum import StrEnum
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table
from rich.text import Text

from cosim.doctor.machine_measures import Lateness, MachineFacts, RunRequirements
from noack.core.number_format import byte_size, duration

LOOP_PROCESSES = 5
"""Processes of a run, the recorder included."""
PLENTY_OF_DATAGRAMS = 4096
"""A receive buffer of this size covers a stall of seconds at any rate of the shipped scenarios."""
LEAST_WRITE_BYTES_PER_S = 20e6
_SLOW_TIMER_NS = 1_000_000
_SETTINGS = {
    "sched_fifo": "SCHED_FIFO",
    "memory_lock": "locked memory",
    "timer_slack": "timer slack",
    "affinity": "a core of its own",
    "cpu_dma_latency": "no deep idle states",
}
_PRIVILEGES = (
    "`ulimit -r 98 -l unlimited` (limits.conf: rtprio, memlock), or "
    "`sudo setcap cap_sys_nice,cap_ipc_lock+ep` on the Python that runs noack"
)
_REMEDIES = {
    "sched_fifo": _PRIVILEGES,
    "memory_lock": _PRIVILEGES,
    "cpu_dma_latency": "let this user write to /dev/cpu_dma_latency, e.g. by a udev rule",
}
_EXTRAS = {
    "fmi": 'plants of kind "fmu"',
    "vehicle": 'plants of kind "vehicle"',
    "cluster": "`noack campaign --scheduler`",
    "mcap": "`noack export --format mcap`",
    "metrics": "`--metrics`",
    "lab": "`noack lab`",
    "notebook": "sliders of `noack.explore`",
}


class FindingStatus(StrEnum):
    """What a finding means for a run; ordered from good to bad."""

    GOOD = "good"
    LIMITED = "limited"
    """A run is possible, with restrictions."""
    BAD = "bad"
    """No run is possible."""


class MachineFinding(NamedTuple):
    """One property of the machine."""

    what: str
    verdict: FindingStatus
    found: str
    means: str = ""
    """Meaning for a run; may be empty."""
    remedy: str = ""


GOOD, LIMITED, BAD = FindingStatus
_VERDICTS = {
    GOOD: ("green", "ready"),
    LIMITED: ("yellow", "ready, with the limits above"),
    BAD: ("bold red", "not ready: no run is possible"),
}
"""Colour of a finding; verdict on the machine if this is the worst finding."""


def judge(machine: MachineFacts, wanted: RunRequirements) -> list[MachineFinding]:
    """Return the findings for a scenario's runs on this machine."""
    return [
        _cores(machine),
        *_settings(machine, wanted),
        _timer(machine),
        _wake_ups("wake-ups without real-time settings", machine.plain, wanted,
                  in_force=not wanted.realtime),
        _wake_ups("wake-ups with the real-time settings applied", machine.realtime, wanted,
                  in_force=wanted.realtime),
        _loopback(machine),
        _buffer(machine, wanted),
        *_ports(machine, wanted),
        _control(machine),
        _disk(machine, wanted),
        _runtime_folder(machine),
        _viewer(machine),
        *_extras(machine),
        _versions(machine),
    ]  # fmt: skip


def worst(findings: Sequence[MachineFinding]) -> FindingStatus:
    """Return the verdict on the whole machine."""
    order = list(FindingStatus)
    return max((finding.verdict for finding in findings), key=order.index)


def _cores(machine: MachineFacts) -> MachineFinding:
    known = [f"{machine.cores} of {machine.cores_online} usable"]
    if machine.load is not None:
        known.append(f"load {machine.load:.1f}")
    if machine.governor is not None:
        known.append(f"governor {machine.governor}")
    what, found = "cores", ", ".join(known)
    if machine.cores < 2:
        means = f"the {LOOP_PROCESSES} processes of a run compete for one core"
        return MachineFinding(what, LIMITED, found, means, "use two cores or more")
    if machine.load is not None and machine.load > machine.cores:
        means = "other programs use the cores: the measurements below are of a busy machine"
        return MachineFinding(what, LIMITED, found, means, "measure again when it is idle")
    if machine.governor == "powersave":
        remedy = "`sudo cpupower frequency-set --governor performance`"
        return MachineFinding(what, LIMITED, found, "cores run slowly after waking up", remedy)
    return MachineFinding(what, GOOD, found)


def _settings(machine: MachineFacts, wanted: RunRequirements) -> Iterator[MachineFinding]:
    applied = [name for key, name in _SETTINGS.items() if machine.granted.get(key) == "applied"]
    what = "real-time settings"
    if applied:
        yield MachineFinding(what, GOOD, f"applied: {', '.join(applied)}")
    for key, name in _SETTINGS.items():
        answer = machine.granted.get(key, "not known")
        if not answer.startswith("not permitted"):
            continue
        verdict, means = GOOD, f"{wanted.name} does not use it"
        if wanted.realtime:
            verdict, means = LIMITED, "runs work without it, and report it"
        yield MachineFinding(what, verdict, f"{name}: {answer}", means, _REMEDIES.get(key, ""))


def _timer(machine: MachineFacts) -> MachineFinding:
    slack = machine.timer_slack_ns
    known = [f"resolution {duration(machine.timer_resolution_ns * 1e-9)}"]
    if slack is not None:
        known.append(f"default slack {duration(slack * 1e-9)}")
    found = ", ".join(known)
    if machine.timer_resolution_ns >= _SLOW_TIMER_NS:
        means = "shorter steps cannot be distinguished"
        return MachineFinding("timers", LIMITED, found, means, "lower plant.rate_hz")
    return MachineFinding("timers", GOOD, found)


def _wake_ups(
    what: str, found: Lateness | str, wanted: RunRequirements, *, in_force: bool
) -> MachineFinding:
    """Compare the lateness of an idle loop with the lateness that the certificates allow."""
    if isinstance(found, str):
        return MachineFinding(what, LIMITED, found, "the lateness of a run cannot be predicted")
    late = (
        f"late by {found.p50_us:.3g} µs (median), {duration(found.p99_us * 1e-6)} (p99), "
        f"{duration(found.max_us * 1e-6)} (max) over {found.wakes:,} wake-ups at "
        f"{wanted.rate_hz:g} Hz"
    )
    allowed = f"the {duration(wanted.allowance_ns * 1e-9)} that {wanted.name}'s certificates allow"
    if not found.beyond:
        near = found.max_us * 1e3 > wanted.allowance_ns / 2
        means = f"all within {allowed}" + (", some above half of it" if near else "")
        return MachineFinding(what, GOOD, late, f"{means}; a longer run may exceed the maximum")
    share = 100 * found.beyond / found.wakes
    first_s = found.wakes / found.beyond / wanted.rate_hz
    means = (
        f"{found.beyond:,} of them ({share:.2g} %) beyond {allowed}: about one every "
        f"{first_s:.2g} s of a run of {wanted.duration_s:g} s; the first makes its claims void"
    )
    if not in_force:
        return MachineFinding(what, GOOD, late, f"{means}. Runs use real-time settings")
    remedy = "raise certificate.late_periods, lower speed or rates, or permit SCHED_FIFO"
    return MachineFinding(what, LIMITED, late, means, remedy)


def _loopback(machine: MachineFacts) -> MachineFinding:
    what, found = "UDP on the loopback", machine.round_trips
    if isinstance(found, str):
        means = "the processes of a run cannot communicate"
        remedy = "`sudo ip link set lo up`; check the firewall's rules for 127.0.0.1"
        return MachineFinding(what, BAD, found, means, remedy)
    p50, p99 = duration(found.p50_us * 1e-6), duration(found.p99_us * 1e-6)
    text = f"round trip {p50} (median), {p99} (p99)"
    if found.lost:
        lost = f"{text}; {found.lost} of {found.sent} lost"
        means = "unintended losses break the bound on consecutive losses"
        return MachineFinding(what, LIMITED, lost, means, "check the firewall and `tc qdisc show`")
    return MachineFinding(what, GOOD, text)


def _buffer(machine: MachineFacts, wanted: RunRequirements) -> MachineFinding:
    what, found = "receive buffer", machine.buffer
    if isinstance(found, str):
        return MachineFinding(what, BAD, found, "no process of a run can receive")
    text = f"{found.datagrams:,} datagrams ({found.granted_bytes // 1024:,} KiB)"
    if found.most_bytes is not None:
        text += f"; net.core.rmem_max is {found.most_bytes:,} bytes"
    stall_s = found.datagrams / wanted.rate_hz
    means = f"the receive buffer covers a {stall_s:.2g} s stall before packets are lost"
    if found.datagrams >= PLENTY_OF_DATAGRAMS:
        return MachineFinding(what, GOOD, text, means)
    return MachineFinding(what, LIMITED, text, means, "`sudo sysctl net.core.rmem_max=4194304`")


def _ports(machine: MachineFacts, wanted: RunRequirements) -> Iterator[MachineFinding]:
    what, means = f"ports of {wanted.name}", f"{wanted.name} cannot run on its configured ports"
    remedy = "stop the program that uses the port, or `--set ports={}`"
    for line in machine.ports_taken:
        yield MachineFinding(what, BAD, line, means, remedy)
    if not machine.ports_taken:
        numbers = ", ".join(str(port) for port in wanted.ports.values())
        yield MachineFinding(what, GOOD, f"{numbers} free" if numbers else "any free port")


def _control(machine: MachineFacts) -> MachineFinding:
    what, found = "control plane", machine.control
    if isinstance(found, str):
        means = "the processes of a run cannot join it"
        remedy = "set XDG_RUNTIME_DIR to a folder of yours that is closed to others"
        return MachineFinding(what, BAD, found, means, remedy)
    text = f"zenoh over a Unix socket answers in {duration(found)}"
    return MachineFinding(what, GOOD, text)


def _disk(machine: MachineFacts, wanted: RunRequirements) -> MachineFinding:
    what, found = "disk", machine.disk
    remedy = "choose another folder by --runs"
    if isinstance(found, str):
        return MachineFinding(what, BAD, found, "nothing can be recorded", remedy)
    text = (
        f"{found.folder}: {byte_size(found.free_bytes)} free, writes "
        f"{byte_size(found.write_bytes_per_s)}/s"
    )
    needs = f"{wanted.name} needs {byte_size(found.needed_bytes)} plus its events"
    if found.free_bytes < found.needed_bytes:
        return MachineFinding(what, BAD, text, needs, f"{remedy}, or shorten horizon_s")
    if found.write_bytes_per_s < LEAST_WRITE_BYTES_PER_S:
        return MachineFinding(what, LIMITED, text, f"{needs}; ending a run takes long", remedy)
    return MachineFinding(what, GOOD, text, needs)


def _runtime_folder(machine: MachineFacts) -> MachineFinding:
    what, problem = "runtime folder", machine.runtime_folder
    if problem is None:
        return MachineFinding(what, GOOD, "private to this user")
    means = "`noack record` cannot open a run for other terminals, and `noack set` finds no run"
    remedy = "set XDG_RUNTIME_DIR to a folder that you own"
    return MachineFinding(what, LIMITED, problem, means, remedy)


def _viewer(machine: MachineFacts) -> MachineFinding:
    what = "viewer"
    if machine.viewer is None:
        means = "no recording is written or shown"
        remedy = "`pip install --force-reinstall noack`"
        return MachineFinding(what, BAD, "rerun cannot be imported", means, remedy)
    text = f"rerun {machine.viewer}"
    if machine.display:
        return MachineFinding(what, GOOD, f"{text}, and a display")
    means = "`noack view` and --live open in a browser, not in a window"
    remedy = "from another machine, forward the port: `ssh -L PORT:127.0.0.1:PORT`"
    return MachineFinding(what, LIMITED, f"{text}, no display", means, remedy)


def _extras(machine: MachineFacts) -> Iterator[MachineFinding]:
    for name, installed in machine.extras.items():
        what, of = f"extra: {name}", _EXTRAS[name]
        if installed:
            yield MachineFinding(what, GOOD, f"installed, for {of}")
        else:
            remedy = f"`pip install 'noack[{name}]'`"
            yield MachineFinding(what, LIMITED, "not installed", f"no {of}", remedy)


def _versions(machine: MachineFacts) -> MachineFinding:
    known = [f"{name} {version}" for name, version in machine.versions.items() if version]
    missing = [name for name, version in machine.versions.items() if not version]
    if not missing:
        return MachineFinding("versions", GOOD, ", ".join(known))
    means = f"{', '.join(missing)}: not installed as a package, so runs cannot record the version"
    return MachineFinding("versions", LIMITED, ", ".join(known), means, "`pip install noack`")


def document(
    machine: MachineFacts, wanted: RunRequirements, findings: Sequence[MachineFinding]
) -> dict[str, Any]:
    """Return ``verdict``, ``findings``, and the numbers behind them, for JSON."""
    return {
        "scenario": wanted._asdict() | {"ports": dict(wanted.ports)},
        "verdict": worst(findings),
        "findings": [finding._asdict() for finding in findings],
        "measured": {
            name: value._asdict() if hasattr(value, "_asdict") else value
            for name, value in asdict(machine).items()
        },
    }


def print_findings(
    console: Console, wanted: RunRequirements, findings: Sequence[MachineFinding]
) -> None:
    """Print each finding, its meaning for a run, and a remedy."""
    table = Table.grid(padding=(0, 2))
    table.add_column(no_wrap=True)
    table.add_column(max_width=26)
    table.add_column(ratio=1)
    for finding in findings:
        text = Text(finding.found)
        if finding.means:
            text.append(f"\n{finding.means}", "" if finding.verdict is not GOOD else "dim")
        if finding.remedy:
            text.append(f"\n→ {finding.remedy}", "cyan")
        table.add_row(
            Text(finding.verdict, _VERDICTS[finding.verdict][0]), Text(finding.what), text
        )
    console.print(table)
    colour, verdict = _VERDICTS[worst(findings)]
    console.print(Text.assemble("this machine, for ", wanted.name, ": ", (verdict, colour)))
