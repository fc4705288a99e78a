"""From numbers to verdicts: what was found, what it means for a run, and what would be better."""

from collections.abc import Iterator, Sequence
from enum import StrEnum
from typing import NamedTuple

from cosim.doctor.machine_facts import Lateness, MachineFacts, RunRequirements

LOOP_PROCESSES = 5
"""Of a run, with the recorder."""
PLENTY_OF_DATAGRAMS = 4096
"""A receive buffer holds so many in the time that a process may be held up: seconds at any rate of
the shipped scenarios."""
LEAST_WRITE_BYTES_PER_S = 20e6
_SLOW_TIMER_NS = 1_000_000
_SETTINGS = {
    "sched_fifo": "SCHED_FIFO",
    "memory_lock": "locked memory",
    "timer_slack": "timer slack",
    "affinity": "a core of its own",
    "cpu_dma_latency": "no deep idle states",
}
_GRANT = (
    "let this user have it, by `ulimit -r 98 -l unlimited` (limits.conf: rtprio, memlock), or by "
    "`sudo setcap cap_sys_nice,cap_ipc_lock+ep` on the Python that runs noack"
)
_REMEDIES = {
    "sched_fifo": _GRANT,
    "memory_lock": _GRANT,
    "cpu_dma_latency": "let this user write to /dev/cpu_dma_latency, e.g. by a udev rule",
}


class FindingStatus(StrEnum):
    """What something means for a run."""

    GOOD = "good"
    LIMITED = "limited"
    """A run goes on, with less than there could be."""
    BAD = "bad"
    """No run is possible."""


class MachineFinding(NamedTuple):
    """One thing that was looked at."""

    what: str
    verdict: FindingStatus
    found: str
    means: str
    """For a run; empty if there is nothing to say."""
    remedy: str = ""


def judge(machine: MachineFacts, wanted: RunRequirements) -> list[MachineFinding]:
    """Return what a machine means for a scenario's runs, one finding for each thing measured."""
    return [
        _cores(machine),
        *_settings(machine, wanted),
        _timer(machine),
        _wake_ups("wake-ups without real-time settings", machine.plain, wanted,
                  in_force=not wanted.realtime),
        _wake_ups("wake-ups with what was granted", machine.realtime, wanted,
                  in_force=wanted.realtime),
        _loopback(machine),
        _buffer(machine, wanted),
        *_ports(machine, wanted),
        _control(machine),
        _disk(machine, wanted),
        _runtime_folder(machine),
        _cache(machine),
        _viewer(machine),
        *_extras(machine),
        _versions(machine),
    ]  # fmt: skip


def worst(findings: Sequence[MachineFinding]) -> FindingStatus:
    """Return the verdict on the machine as a whole."""
    order = list(FindingStatus)
    return max((one.verdict for one in findings), key=order.index)


def _cores(machine: MachineFacts) -> MachineFinding:
    known = [f"{machine.cores} of {machine.cores_online} usable"]
    if machine.load is not None:
        known.append(f"load {machine.load:.1f}")
    if machine.governor is not None:
        known.append(f"governor {machine.governor}")
    means, remedy, verdict = "", "", FindingStatus.GOOD
    if machine.cores < 2:
        verdict = FindingStatus.LIMITED
        means = f"the {LOOP_PROCESSES} processes of a run stand in each other's way"
        remedy = "give this program two cores or more"
    elif machine.load is not None and machine.load > machine.cores:
        verdict = FindingStatus.LIMITED
        means = "others want the cores, too: what is measured below is of a busy machine"
        remedy = "run it again when the machine is idle"
    elif machine.governor == "powersave":
        verdict = FindingStatus.LIMITED
        means = "cores are slow when they wake up"
        remedy = "`sudo cpupower frequency-set --governor performance`"
    return MachineFinding("cores", verdict, ", ".join(known), means, remedy)


def _settings(machine: MachineFacts, wanted: RunRequirements) -> Iterator[MachineFinding]:
    granted = [said for name, said in _SETTINGS.items() if machine.granted.get(name) == "applied"]
    what = "real-time settings"
    if granted:
        yield MachineFinding(what, FindingStatus.GOOD, f"applied: {', '.join(granted)}", "")
    for name, said in _SETTINGS.items():
        answer = machine.granted.get(name, "not known")
        if not answer.startswith("not permitted"):
            continue
        if wanted.realtime:
            means, verdict = "a run goes on without it, and says so", FindingStatus.LIMITED
        else:
            means, verdict = f"{wanted.name} does not ask for it", FindingStatus.GOOD
        yield MachineFinding(what, verdict, f"{said} {answer}", means, _REMEDIES.get(name, ""))


def _timer(machine: MachineFacts) -> MachineFinding:
    slack = machine.timer_slack_ns
    known = [f"resolution {_time(machine.timer_resolution_ns * 1e-3)}"]
    if slack is not None:
        known.append(f"slack {_time(slack * 1e-3)} unless asked for less")
    if machine.timer_resolution_ns >= _SLOW_TIMER_NS:
        means = "steps cannot be told apart that are nearer"
        return MachineFinding(
            "timers", FindingStatus.LIMITED, ", ".join(known), means, "lower plant.rate_hz"
        )
    return MachineFinding("timers", FindingStatus.GOOD, ", ".join(known), "")


def _wake_ups(
    what: str, found: Lateness | str, wanted: RunRequirements, *, in_force: bool
) -> MachineFinding:
    """Judge how late a loop was that had nothing to do, against what certificates allow."""
    if isinstance(found, str):
        return MachineFinding(
            what, FindingStatus.LIMITED, found, "how late a run will be is not known"
        )
    late = (
        f"{_time(found.p50_us)} late in the median, {_time(found.p99_us)} p99, "
        f"{_time(found.max_us)} at the most, of {found.wakes:,} at {wanted.rate_hz:g} Hz"
    )
    allowed = f"the {_time(wanted.allowance_ns * 1e-3)} that {wanted.name}'s certificates allow"
    if not found.beyond:
        near = found.max_us * 1e3 > wanted.allowance_ns / 2
        means = f"all within {allowed}" + (", some by less than a half of it" if near else "")
        return MachineFinding(
            what, FindingStatus.GOOD, late, f"{means}; a longer run may meet a later one"
        )
    share = 100 * found.beyond / found.wakes
    first_s = found.wakes / found.beyond / wanted.rate_hz
    means = (
        f"{found.beyond:,} of them ({share:.2g} %) beyond {allowed}: at this rate a run would void "
        f"them every {first_s:.2g} s, of its {wanted.duration_s:g} s"
    )
    if not in_force:
        return MachineFinding(
            what, FindingStatus.GOOD, late, f"{means}; but runs ask for real-time settings"
        )
    remedy = "allow for more by certificate.late_periods, lower speed or rates, or get SCHED_FIFO"
    return MachineFinding(what, FindingStatus.LIMITED, late, means, remedy)


def _loopback(machine: MachineFacts) -> MachineFinding:
    what, found = "UDP on the loopback", machine.round_trips
    if isinstance(found, str):
        means = "processes of a run cannot hear each other"
        remedy = "`sudo ip link set lo up`; let no firewall drop what goes to 127.0.0.1"
        return MachineFinding(what, FindingStatus.BAD, found, means, remedy)
    text = f"there and back in {_time(found.p50_us)}, {_time(found.p99_us)} p99"
    if found.lost:
        means = "a loss that nobody ordered breaks the bound on successive drops"
        lost = f"{text}; {found.lost} of {found.sent} lost"
        return MachineFinding(
            what, FindingStatus.LIMITED, lost, means, "find who drops it: a firewall, tc"
        )
    return MachineFinding(what, FindingStatus.GOOD, text, "")


def _buffer(machine: MachineFacts, wanted: RunRequirements) -> MachineFinding:
    what, found = "receive buffer", machine.buffer
    if isinstance(found, str):
        return MachineFinding(what, FindingStatus.BAD, found, "no process of a run can receive")
    text = f"holds {found.datagrams:,} datagrams ({found.granted_bytes // 1024:,} KiB)"
    if found.most_bytes is not None:
        text += f"; net.core.rmem_max is {found.most_bytes:,}"
    lasts_s = found.datagrams / wanted.rate_hz
    means = f"a process may be held up for {lasts_s:.2g} s before one is lost that nobody ordered"
    if found.datagrams >= PLENTY_OF_DATAGRAMS:
        return MachineFinding(what, FindingStatus.GOOD, text, means)
    return MachineFinding(
        what, FindingStatus.LIMITED, text, means, "`sudo sysctl net.core.rmem_max=4194304`"
    )


def _ports(machine: MachineFacts, wanted: RunRequirements) -> Iterator[MachineFinding]:
    what = f"ports of {wanted.name}"
    for line in machine.ports_taken:
        means = f"{wanted.name} cannot run with the ports that it names"
        yield MachineFinding(
            what, FindingStatus.BAD, line, means, "end who has them, or `--set ports={}`"
        )
    if not machine.ports_taken:
        numbers = ", ".join(str(port) for port in wanted.ports.values())
        yield MachineFinding(
            what, FindingStatus.GOOD, f"{numbers} free" if numbers else "any will do", ""
        )


def _control(machine: MachineFacts) -> MachineFinding:
    what, found = "control plane", machine.control
    if isinstance(found, str):
        means = "the processes of a run cannot meet"
        remedy = "let programs of this user connect over TCP to 127.0.0.1"
        return MachineFinding(what, FindingStatus.BAD, found, means, remedy)
    text = f"zenoh over TCP on the loopback answers in {_time(found * 1e6)}"
    return MachineFinding(what, FindingStatus.GOOD, text, "")


def _disk(machine: MachineFacts, wanted: RunRequirements) -> MachineFinding:
    what, found = "disk", machine.disk
    remedy = "name another place by --runs"
    if isinstance(found, str):
        return MachineFinding(what, FindingStatus.BAD, found, "nothing can be recorded", remedy)
    text = (
        f"{found.folder}: {_bytes(found.free_bytes)} free, {_bytes(found.write_bytes_per_s)} a "
        "second written"
    )
    needs = f"{wanted.name} takes {_bytes(found.needed_bytes)}, and what its events take"
    if found.free_bytes < found.needed_bytes:
        return MachineFinding(
            what, FindingStatus.BAD, text, needs, f"{remedy}, or shorten horizon_s"
        )
    if found.write_bytes_per_s < LEAST_WRITE_BYTES_PER_S:
        return MachineFinding(
            what, FindingStatus.LIMITED, text, f"{needs}; a run's end takes long", remedy
        )
    return MachineFinding(what, FindingStatus.GOOD, text, needs)


def _runtime_folder(machine: MachineFacts) -> MachineFinding:
    what, said = "runtime folder", machine.runtime_folder
    if said is None:
        return MachineFinding(what, FindingStatus.GOOD, "yours, and closed to others", "")
    means = "`noack record` cannot open a run for other terminals, `noack set` finds none"
    return MachineFinding(
        what, FindingStatus.LIMITED, said, means, "set XDG_RUNTIME_DIR to a folder of yours"
    )


def _cache(machine: MachineFacts) -> MachineFinding:
    what = "compiled code"
    if machine.cache:
        return MachineFinding(what, FindingStatus.GOOD, "is kept in your cache", "")
    means = "campaigns, netem on its own, and vehicles with tyres compile anew each time"
    remedy = "set XDG_CACHE_HOME to a folder that you can write to, and nobody else"
    return MachineFinding(what, FindingStatus.LIMITED, "cannot be kept", means, remedy)


def _viewer(machine: MachineFacts) -> MachineFinding:
    what = "viewer"
    if machine.viewer is None:
        means = "no recording is written or shown"
        remedy = "`pip install --force-reinstall noack`"
        return MachineFinding(what, FindingStatus.BAD, "rerun cannot be imported", means, remedy)
    text = f"rerun {machine.viewer}"
    if machine.display:
        return MachineFinding(what, FindingStatus.GOOD, f"{text}, and a display", "")
    means = "`noack view` and --live show a page on this machine, in no window"
    remedy = "to look from another one, forward its port: `ssh -L PORT:127.0.0.1:PORT`"
    return MachineFinding(what, FindingStatus.LIMITED, f"{text}, no display", means, remedy)


_OF_EXTRAS = {
    "fmi": 'plants of kind "fmu"',
    "vehicle": 'plants of kind "vehicle"',
    "cluster": "`noack campaign --scheduler`",
}


def _extras(machine: MachineFacts) -> Iterator[MachineFinding]:
    for name, there in machine.extras.items():
        what, of = f"extra: {name}", _OF_EXTRAS[name]
        if there:
            yield MachineFinding(what, FindingStatus.GOOD, "installed", f"{of}")
        else:
            remedy = f"`pip install 'noack[{name}]'`"
            yield MachineFinding(what, FindingStatus.LIMITED, "not installed", f"no {of}", remedy)


def _versions(machine: MachineFacts) -> MachineFinding:
    known = [f"{name} {version}" for name, version in machine.versions.items() if version]
    missing = [name for name, version in machine.versions.items() if not version]
    if not missing:
        return MachineFinding("versions", FindingStatus.GOOD, ", ".join(known), "")
    means = f"{', '.join(missing)}: not installed as a package, so that runs do not say which it is"
    return MachineFinding(
        "versions", FindingStatus.LIMITED, ", ".join(known), means, "`pip install noack`"
    )


def _time(value_us: float) -> str:
    """A time in the unit that suits it."""
    for unit, size in (("s", 1e6), ("ms", 1e3), ("µs", 1.0)):
        if abs(value_us) >= size:
            return f"{value_us / size:.3g} {unit}"
    return f"{value_us * 1e3:.3g} ns"


def _bytes(value: float) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.0f} bytes"
