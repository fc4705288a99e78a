"""Findings on a machine, from its measurements: their meaning for a run, and remedies.

A check is a function with the decorator ``_check``; it yields a verdict for each thing it found.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from enum import StrEnum
from typing import NamedTuple

from cosim.doctor.machine_measures import MachineFacts, RunRequirements
from netem.core.number_format import byte_size, duration
from netem.output.document import Block, Document, Sentence
from netem.output.result_tables import ResultTable, Tone

LOOP_PROCESSES = 5
"""Processes of a run, the recorder included."""
PLENTY_OF_DATAGRAMS = 4096
"""A receive buffer of this size covers a stall of seconds at any rate of the shipped scenarios."""
LEAST_WRITE_BYTES_PER_S = 20e6
"""A slower disk may not keep up with the record of a run."""
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


class MachineVerdict(StrEnum):
    """What a finding, or the worst one, means for a run; ordered from good to bad."""

    GOOD = "good"
    LIMITED = "limited"
    """A run is possible, with restrictions."""
    BAD = "bad"
    """No run is possible."""


class MachineFinding(NamedTuple):
    """One property of the machine."""

    what: str
    verdict: MachineVerdict
    found: str
    means: str = ""
    """Meaning for a run; may be empty."""
    remedy: str = ""


GOOD, LIMITED, BAD = MachineVerdict
_VERDICTS = {
    GOOD: (Tone.GOOD, "ready"),
    LIMITED: (Tone.DOUBTFUL, "ready, with the limits above"),
    BAD: (Tone.BAD, "not ready: no run is possible"),
}
"""Tone of a finding; verdict on the machine if this is the worst finding."""


Outcome = tuple[MachineVerdict, *tuple[str, ...]]
"""A finding without ``what``."""
_checks: list[Callable[[MachineFacts, RunRequirements], Iterator[MachineFinding]]] = []


def _check(title: str) -> Callable[[Callable[[MachineFacts, RunRequirements], Iterator[Outcome]]], None]:
    """Register a check with this title; {} in it is the scenario's name."""

    def register(check: Callable[[MachineFacts, RunRequirements], Iterator[Outcome]]) -> None:
        _checks.append(
            lambda machine, required: (
                MachineFinding(title.format(required.name), *outcome) for outcome in check(machine, required)
            )
        )

    return register


def find_all(machine: MachineFacts, required: RunRequirements) -> list[MachineFinding]:
    """Return the findings for a scenario's runs on this machine."""
    return [finding for check in _checks for finding in check(machine, required)]


def worst(findings: Sequence[MachineFinding]) -> MachineVerdict:
    """Return the verdict on the whole machine."""
    order = list(MachineVerdict)
    return max((finding.verdict for finding in findings), key=order.index)


@_check("cores")
def _cores(machine: MachineFacts, _: RunRequirements) -> Iterator[Outcome]:
    facts = [f"{machine.cores} of {machine.cores_online} usable"]
    if machine.load is not None:
        facts.append(f"load {machine.load:.1f}")
    if machine.governor is not None:
        facts.append(f"governor {machine.governor}")
    text = ", ".join(facts)
    if machine.cores < 2:
        means = f"the {LOOP_PROCESSES} processes of a run compete for one core"
        yield LIMITED, text, means, "use two cores or more"
    elif machine.load is not None and machine.load > machine.cores:
        means = "other programs use the cores: the measurements below are of a busy machine"
        yield LIMITED, text, means, "measure again when it is idle"
    elif machine.governor == "powersave":
        remedy = "`sudo cpupower frequency-set --governor performance`"
        yield LIMITED, text, "cores run slowly after waking up", remedy
    else:
        yield GOOD, text


@_check("real-time settings")
def _settings(machine: MachineFacts, required: RunRequirements) -> Iterator[Outcome]:
    applied = [name for key, name in _SETTINGS.items() if machine.settings.get(key) == "applied"]
    if applied:
        yield GOOD, f"applied: {', '.join(applied)}"
    for key, name in _SETTINGS.items():
        answer = machine.settings.get(key, "not known")
        if not answer.startswith("not permitted"):
            continue
        verdict, means = GOOD, f"{required.name} does not use it"
        if required.realtime:
            verdict, means = LIMITED, "runs work without it, and report it"
        yield verdict, f"{name}: {answer}", means, _REMEDIES.get(key, "")


@_check("wake-ups")
def _wake_ups(machine: MachineFacts, required: RunRequirements) -> Iterator[Outcome]:
    """Compare the lateness of an idle loop with the lateness that the certificates allow."""
    if isinstance(lateness := machine.lateness, str):
        yield LIMITED, lateness, "the lateness of a run cannot be predicted"
        return
    late = (
        f"late by {lateness.p50_us:.3g} µs (median), {duration(lateness.p99_us * 1e-6)} (p99), "
        f"{duration(lateness.max_us * 1e-6)} (max) over {lateness.wakes:,} wake-ups at "
        f"{required.rate_hz:g} Hz"
    )
    allowed = f"the {duration(required.allowance_ns * 1e-9)} that {required.name}'s certificates allow"
    if not lateness.too_late and lateness.p99_us * 1e3 > required.period_ns:
        period = duration(required.period_ns * 1e-9)
        means = f"all within {allowed}, but 1 % are later than a step of the plant, {period}"
        yield LIMITED, late, means, "use a less busy machine, or lower speed or rates"
        return
    if not lateness.too_late:
        near = lateness.max_us * 1e3 > required.allowance_ns / 2
        means = f"all within {allowed}" + (", some above half of it" if near else "")
        yield GOOD, late, f"{means}; a longer run may exceed the maximum"
        return
    share = 100 * lateness.too_late / lateness.wakes
    first_s = lateness.wakes / lateness.too_late / required.rate_hz
    means = (
        f"{lateness.too_late:,} of them ({share:.2g} %) beyond {allowed}: about one every "
        f"{first_s:.2g} s of a run of {required.duration_s:g} s; from the first on, the run needs a "
        "certificate for its actual lateness"
    )
    yield LIMITED, late, means, "raise certificate.late_periods, or lower speed or rates"


@_check("receive buffer")
def _buffer(machine: MachineFacts, required: RunRequirements) -> Iterator[Outcome]:
    if isinstance(buffer := machine.buffer, str):
        yield BAD, buffer, "no process of a run can receive"
        return
    text = f"{buffer.datagrams:,} datagrams ({buffer.buffer_bytes // 1024:,} KiB)"
    if buffer.most_bytes is not None:
        text += f"; net.core.rmem_max is {buffer.most_bytes:,} bytes"
    stall_s = buffer.datagrams / required.rate_hz
    means = f"the receive buffer covers a {stall_s:.2g} s stall before packets are lost"
    if buffer.datagrams >= PLENTY_OF_DATAGRAMS:
        yield GOOD, text, means
    else:
        yield LIMITED, text, means, "`sudo sysctl net.core.rmem_max=4194304`"


@_check("ports of {}")
def _ports(machine: MachineFacts, required: RunRequirements) -> Iterator[Outcome]:
    remedy = "stop the program that uses the port, or `--set ports={}`"
    for line in machine.ports_taken:
        yield BAD, line, f"{required.name} cannot run on its configured ports", remedy
    if not machine.ports_taken:
        numbers = ", ".join(str(port) for port in required.ports.values())
        yield GOOD, f"{numbers} free" if numbers else "any free port"


@_check("control plane")
def _control(machine: MachineFacts, _: RunRequirements) -> Iterator[Outcome]:
    if isinstance(query_s := machine.control, str):
        means = "the processes of a run cannot join it"
        remedy = "set XDG_RUNTIME_DIR to a folder of yours that is closed to others"
        yield BAD, query_s, means, remedy
        return
    yield GOOD, f"zenoh over a Unix socket answers in {duration(query_s)}"


@_check("disk")
def _disk(machine: MachineFacts, required: RunRequirements) -> Iterator[Outcome]:
    remedy = "choose another folder by --runs"
    if isinstance(disk := machine.disk, str):
        yield BAD, disk, "nothing can be recorded", remedy
        return
    text = f"{disk.folder}: {byte_size(disk.free_bytes)} free, writes {byte_size(disk.write_bytes_per_s)}/s"
    needs = f"{required.name} needs {byte_size(disk.needed_bytes)} plus its events"
    if disk.free_bytes < disk.needed_bytes:
        yield BAD, text, needs, f"{remedy}, or shorten horizon_s"
    elif disk.write_bytes_per_s < LEAST_WRITE_BYTES_PER_S:
        yield LIMITED, text, f"{needs}; ending a run takes long", remedy
    else:
        yield GOOD, text, needs


@_check("runtime folder")
def _runtime_folder(machine: MachineFacts, _: RunRequirements) -> Iterator[Outcome]:
    means = "`noack record` cannot open a run for other terminals, and `noack set` finds no run"
    if (problem := machine.runtime_folder) is not None:
        yield LIMITED, problem, means, "set XDG_RUNTIME_DIR to a folder that you own"
    else:
        yield GOOD, "private to this user"


@_check("viewer")
def _viewer(machine: MachineFacts, _: RunRequirements) -> Iterator[Outcome]:
    text = f"rerun {machine.viewer}"
    if machine.viewer is None:
        remedy = "`pip install 'noack[viewer]'`"
        yield LIMITED, "not installed", "no recording is written or shown", remedy
    elif machine.display:
        yield GOOD, f"{text}, and a display"
    else:
        means = "`noack view` and --live open in a browser, not in a window"
        remedy = "from another machine, forward the port: `ssh -L PORT:127.0.0.1:PORT`"
        yield LIMITED, f"{text}, no display", means, remedy


def findings_document(
    machine: MachineFacts, required: RunRequirements, findings: Sequence[MachineFinding]
) -> Document:
    """Return each finding, its meaning for a run, and a remedy; for JSON also the numbers behind them."""
    rows = [(finding.verdict, finding.what, _lines(finding)) for finding in findings]
    tone, verdict = _VERDICTS[worst(findings)]
    data = {
        "scenario": asdict(required),
        "verdict": worst(findings),
        "findings": [finding._asdict() for finding in findings],
        "measured": asdict(machine),
    }
    blocks: list[Block] = [
        ResultTable("", "", (), rows, tones={kind: tone for kind, (tone, _) in _VERDICTS.items()}),
        Sentence(text=f"this machine, for {required.name}: {verdict}", tone=tone),
    ]
    return Document(title=required.name, data=data, blocks=blocks)


def _lines(finding: MachineFinding) -> str:
    remedy = f"→ {finding.remedy}" if finding.remedy else ""
    return "\n".join(filter(None, (finding.found, finding.means, remedy)))
