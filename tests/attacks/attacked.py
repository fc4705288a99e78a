"""A run under attack, one process at a time, so that this user can read its ticket and key."""

import json
import os
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import psutil

from benchmarks.programs import TwoHosts, udp_port
from cosim.record.run_record import RunRecord, load_record
from noack.protocol.record_tables import (
    CONTROLLER_DELIVERY,
    NETEM_PACKET,
    PLANT_ACTUATION,
    SENSOR_MEASUREMENT,
)
from noack.protocol.topology import LOOP_ROLES, RECEIVES, sender_to
from noack.protocol.wire_format import Flow
from noack.runtime.address import LOOPBACK
from noack.runtime.join_ticket import Ticket, loads
from noack.scenario.resolution import loop_of
from tests.attacks.kinds import Target
from tests.attacks.sender import Plan, Sent, carry_out
from tests.integration.conftest import PATIENCE_S, starting, wait_for

AWAY = "controller"
"""The process on the second host."""
_ATTEMPTS = 3


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

    def sent_to(self, role: str) -> Counter[str]:
        """Return how many hostile datagrams a process must reject, by reason."""
        total: Counter[str] = Counter()
        for (to, _, _, reason), number in self.sent.items():
            total[reason] += number * (to == role)
        return total

    def kinds_sent(self, role: str, sender: str) -> set[str]:
        return {kind for to, by, kind, _ in self.sent if (to, by) == (role, sender)}


def may_forge_addresses() -> bool:
    """Whether this user is permitted to send from a forged source address."""
    try:
        socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_UDP).close()
    except OSError:
        return False
    return True


class Run:
    """An active run, started one process at a time; ``stack`` ends what remains."""

    def __init__(
        self, stack: ExitStack, folder: Path, hosts: TwoHosts | None, *arguments: str
    ) -> None:
        self._folder, self._hosts = folder, hosts
        self._begin = stack.enter_context(starting())
        invitation = str(folder / "invitation.json")
        network = (
            ("--set", "ports={}") if hosts is None
            else ("--listen", _addresses(hosts)[0], "--invitation", invitation)
        )  # fmt: skip
        self._recording = self._start(
            0, "record", "lane_following", "--runs", str(folder / "runs"), "--no-report",
            *network, *arguments,
        )  # fmt: skip
        self.processes = {
            role: self._start(1, role, "--invitation", invitation)
            if hosts is not None and role == AWAY
            else self._start(0, role)
            for role in LOOP_ROLES
        }

    def _start(self, host: int, *command: str) -> "subprocess.Popen[str]":
        before = () if self._hosts is None else self._hosts.inside(host)
        return self._begin(*command, "--json", before=before, runtime=self._folder)

    def targets(self) -> list[Target]:
        """Wait until the loop runs; return its processes with their ports."""
        ticket = self._ticket()
        run_dir = Path(ticket.run_dir)
        for table in (PLANT_ACTUATION, SENSOR_MEASUREMENT, CONTROLLER_DELIVERY):
            spooled = run_dir / "spool" / f"{table}.recorder"
            self._wait(lambda spooled=spooled: spooled.exists() and spooled.stat().st_size > 0)
        ports = {
            role: getattr(ticket.scenario.ports, role) or udp_port(psutil.Process(process.pid))
            for role, process in self.processes.items()
        }
        loop = loop_of(ticket.scenario)
        one_host = self._hosts is None
        home, away = (LOOPBACK, LOOPBACK) if self._hosts is None else _addresses(self._hosts)
        return [
            Target(
                role, ports[role], ports[sender_to(role, flow)], flow,
                loop.m if flow is Flow.ACTUATION else loop.n, ticket.run_id, ticket.key,
                away if role == AWAY else home, one_host or sender_to(role, flow) == AWAY,
            )
            for role, flow in RECEIVES.items()
        ]  # fmt: skip

    def finish(self, sent: Sent) -> Attacked:
        """Wait for the end of the run; return its result."""
        stdout, stderr = self._recording.communicate(timeout=PATIENCE_S + 600)
        for process in self.processes.values():
            process.communicate(timeout=PATIENCE_S)
        statuses = [self._recording.returncode, *(p.returncode for p in self.processes.values())]
        record = load_record((self._folder / "runs" / "latest").resolve())
        return Attacked(max(statuses), json.loads(stdout), stderr, record, sent)

    def _ticket(self) -> Ticket:
        path = self._folder / f"noack-{os.getuid()}" / "default.json"
        self._wait(path.exists)
        return loads(path.read_text())

    def _wait(self, condition: Callable[[], bool]) -> None:
        wait_for(lambda: condition() or self._recording.poll() is not None)
        assert self._recording.poll() is None, self._recording.communicate()


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

    Repeat it with a longer run if a busy machine let the run end before the attack.

    Args:
        folder: the folder for the run directories.
        per_port: number of datagrams to each port.
        rate_hz: datagrams per second to each port.
        forge_addresses: whether to send from the peers' addresses, too.
        speed: the speed of the run relative to real time.
        hosts: the controller and the attacker are on the second one; None: all are on this one.
    """
    sending_s = per_port / rate_hz
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        pool.submit(carry_out, Plan((), 0, 1.0, False, 0.0)).result()  # the process has started
        for attempt in range(_ATTEMPTS):
            (folder / str(attempt)).mkdir()
            horizon_s = 3**attempt * speed * (1.5 * sending_s + 7.0)
            options = ("--set", f"speed={speed}", "--set", f"horizon_s={horizon_s:.0f}")
            with ExitStack() as stack:
                run = Run(stack, folder / str(attempt), hosts, *options)
                targets = run.targets()
                until_s = time.monotonic() + 1.5 * sending_s + 3.0
                namespace = None if hosts is None else hosts.names[1]
                plan = Plan(targets, per_port, rate_hz, forge_addresses, until_s, namespace)
                sent = pool.submit(carry_out, plan).result()
                all_received = have_read(targets, run.processes)
                attacked = run.finish(sent)
            if all_received:
                break
    return attacked


def have_read(targets: list[Target], processes: Mapping[str, "subprocess.Popen[str]"]) -> bool:
    """Wait until the processes have read what was sent; whether none has ended before."""

    def all_read() -> bool:
        return not any(unread_bytes(processes[one.role].pid)[one.port] for one in targets)

    try:
        wait_for(all_read)
    except (FileNotFoundError, KeyError):
        return False
    return True


def unread_bytes(pid: int) -> dict[int, int]:
    """Return the bytes that wait in the UDP sockets of a process's host, by port."""
    found: dict[int, int] = {}
    for name in ("udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{name}").read_text().splitlines()[1:]:
            _, local, _, _, queues, *_ = line.split()
            port, waiting_bytes = (int(word.rpartition(":")[2], 16) for word in (local, queues))
            found[port] = found.get(port, 0) + waiting_bytes
    return found


def _addresses(hosts: TwoHosts) -> tuple[str, str]:
    return hosts.addresses[0][0], hosts.addresses[1][0]
