"""A run under attack, one process at a time, so that this user can read its run descriptor and key.

The checks of such a run each yield one line per failure.
"""

import socket
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil

from cosim.record.run_record import RunRecord, load_record
from netem.core.address import LOOPBACK
from netem.core.errors import ExitStatus
from netem.core.packet_rows import NETEM_PACKET
from noack.protocol.record_tables import CONTROLLER_DELIVERY, PLANT_ACTUATION, SENSOR_MEASUREMENT
from noack.protocol.roles import LOOP_ROLES, RECEIVES, sender_to
from noack.protocol.wire_format import Flow, Rejection
from noack.runtime.counting_sockets import DROPPED_IN_FLOOD
from noack.scenario.resolution import loop_of
from tests.attacks.kinds import Plan, Sent, Target, carry_out
from tests.helpers.live_runs import udp_port
from tests.helpers.run_by_hand import AWAY, RunByHand
from tests.helpers.two_hosts import TwoHosts


@dataclass(frozen=True)
class Attacked:
    """The result of a run under attack."""

    status: int
    summary: Mapping[str, Any]
    stderr: str
    record: RunRecord
    sent: Sent

    def channel(self, role: str) -> Any:
        """Return the datagram counters of a process."""
        return self.record.reports[role]["channel"]

    def accepted(self, role: str) -> int:
        """Datagrams that a process accepted, or that the emulator, which verifies none, relayed."""
        relayed = len(self.record[NETEM_PACKET])
        return int(self.channel(role).get("accepted", relayed))

    def sent_to(self, role: str, sender: str | None = None) -> Counter[str]:
        """Return how many hostile datagrams were sent to a process, by kind."""
        total: Counter[str] = Counter()
        for (to, by, kind), number in self.sent.items():
            if to == role and sender in (None, by):
                total[kind] += number
        return total


def may_forge_addresses() -> bool:
    """Whether this user is permitted to send from a forged source address."""
    try:
        socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_UDP).close()
    except OSError:
        return False
    return True


def targets_of(run: RunByHand) -> list[Target]:
    """Wait until the loop runs; return its processes with their ports."""
    descriptor = run.descriptor()
    run_dir = Path(descriptor.run_dir)
    for table in (PLANT_ACTUATION, SENSOR_MEASUREMENT, CONTROLLER_DELIVERY):
        spooled = run_dir / "spool" / f"{table}.recorder"
        run.wait(lambda spooled=spooled: spooled.exists() and spooled.stat().st_size > 0)
    ports = {
        role: getattr(descriptor.scenario.ports, role) or udp_port(psutil.Process(process.pid))
        for role, process in run.processes.items()
    }
    loop = loop_of(descriptor.scenario)
    one_host = run.hosts is None
    home, away = (LOOPBACK, LOOPBACK) if run.hosts is None else _addresses(run.hosts)
    return [
        Target(
            role, ports[role], ports[sender_to(role, flow)], flow,
            loop.m if flow is Flow.ACTUATION else loop.n, descriptor.run_id, descriptor.key,
            away if role == AWAY else home, one_host or sender_to(role, flow) == AWAY,
        )
        for role, flow in RECEIVES.items()
    ]  # fmt: skip


def attack(
    folder: Path,
    per_port: int,
    rate_hz: float,
    *,
    forge_addresses: bool,
    speed: float = 1.0,
    hosts: TwoHosts | None = None,
) -> Attacked:
    """Attack all four ports of a run of the paper's example while it runs.

    The run ends, on request, when its processes have read what was sent.

    Args:
        folder: the folder for the run directories.
        per_port: number of datagrams to each port.
        rate_hz: datagrams per second to each port.
        forge_addresses: whether to send from the peers' addresses, too.
        speed: the speed of the run relative to real time.
        hosts: the controller and the attacker are on the second one; None: all are on this one.
    """
    with ProcessPoolExecutor(1, get_context("spawn")) as pool, ExitStack() as stack:
        pool.submit(carry_out, Plan((), 0, 1.0, False)).result()  # the process has started
        run = RunByHand(stack, folder, hosts, "--set", f"speed={speed}", "--set", "horizon_s=1e5")
        targets = targets_of(run)
        namespace = None if hosts is None else hosts.names[1]
        plan = Plan(targets, per_port, rate_hz, forge_addresses, namespace)
        sent = pool.submit(carry_out, plan).result()
        run.wait(lambda: all_read(targets, run))
        finished = run.stop()
    record = load_record(finished.run_dir)
    return Attacked(finished.status, finished.summary, finished.stderr, record, sent)


def all_read(targets: list[Target], run: RunByHand) -> bool:
    """Whether the processes have read what was sent to them."""
    return not any(unread_bytes(run.processes[target.role].pid)[target.port] for target in targets)


def unread_bytes(pid: int) -> dict[int, int]:
    """Return the bytes that wait in the UDP sockets of a process's host, by port."""
    unread: dict[int, int] = {}
    for name in ("udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:]:
            _, local, _, _, queues, *_ = line.split()
            port, waiting_bytes = (int(word.rpartition(":")[2], 16) for word in (local, queues))
            unread[port] = unread.get(port, 0) + waiting_bytes
    return unread


def _addresses(hosts: TwoHosts) -> tuple[str, str]:
    return hosts.addresses[0][0], hosts.addresses[1][0]


_TAKEN = {
    "plant": PLANT_ACTUATION,
    "sensor": SENSOR_MEASUREMENT,
    "netem": NETEM_PACKET,
    "controller": CONTROLLER_DELIVERY,
}
"""The table with a row for each datagram that a process accepts."""


def ends_well(run: Attacked) -> Iterator[str]:
    """The run goes on until it is stopped, and every process exits as one that is stopped."""
    if run.status != ExitStatus.INTERRUPTED:
        yield f"exit status {run.status}: {run.stderr.strip()}"
    if run.summary["exit"]["reason"] != "stopped by the user (SIGINT)":
        yield f"ended: {run.summary['exit']['reason']}"


def nothing_is_accepted(run: Attacked) -> Iterator[str]:
    """Each process accepted only what its peer sent: all but what was on its way when the run was stopped."""
    for role in LOOP_ROLES:
        sent = run.channel(sender_to(role, RECEIVES[role]))["sent"]
        processed = len(run.record[_TAKEN[role]])
        if not run.accepted(role) == processed <= sent:
            yield f"{role}: {sent} from its peer, {run.accepted(role)} accepted, {processed} acted on"


def all_are_accounted_for(run: Attacked) -> Iterator[str]:
    """Each hostile datagram was rejected; the emulator rejects by address only."""
    for role in LOOP_ROLES:
        sent, rejected = run.sent_to(role).total(), run.channel(role)["rejected"]
        if sum(rejected.values()) != sent:
            yield f"{role}: {sent} sent, {rejected}"
        if role == "netem" and not rejected.keys() <= {Rejection.SOURCE.value, DROPPED_IN_FLOOD}:
            yield f"the emulator verifies addresses only, {rejected}"


def nothing_is_lost(run: Attacked) -> Iterator[str]:
    """All datagrams of the loop arrive, and the record is complete."""
    (loop,) = run.summary["loops"]
    for key in ("unintended_losses", "missing_samples"):
        if loop[key]:
            yield f"{key}: {loop[key]}, {loop['unintended_losses_by_leg']}"
    for role in LOOP_ROLES:
        if run.channel(role)["kernel_drops"] not in (0, None):
            yield f"{role}: {run.channel(role)['kernel_drops']} lost in the kernel"


def the_loop_computes_what_it_should(run: Attacked) -> Iterator[str]:
    """Replay gives the recorded outputs, and (I1) holds to rounding."""
    (loop,) = run.summary["loops"]
    if not (loop["replay"]["bit_exact"] and loop["replay"]["complete"]):
        yield f"replay: {loop['replay']}"
    if not loop["identity_residual_max"] < 1e-11:
        yield f"identity residual {loop['identity_residual_max']}"


def no_claim_is_violated(run: Attacked) -> Iterator[str]:
    """No claim is violated; claims may end because of deadlines missed on a busy machine."""
    claims = run.summary["loops"][0]["claims"]
    if not any("state" in claim["what"] and claim["certified"] is not None for claim in claims):
        yield "no envelope of the state is claimed"
    yield from (str(claim) for claim in claims if claim["verdict"] == "violated")
    violations = run.summary["loops"][0]["violations"]
    yield from (str(violation) for violation in violations if violation["cause"] == "dropouts")


CHECKS: Mapping[str, Callable[[Attacked], Iterator[str]]] = {
    check.__name__: check
    for check in (
        ends_well, nothing_is_accepted, all_are_accounted_for, nothing_is_lost,
        the_loop_computes_what_it_should, no_claim_is_violated,
    )
}  # fmt: skip
