"""Two hosts: the bound of the offset between their clocks, and the loop across them.

The hosts are network namespaces, which a veth link connects. For the bound, one end of an exchange
of timestamps runs on each: a reference, and a client whose monotonic clock is ahead and drifts, so
that the true offset is known at any time. The alternative is what a plain NTP client and server do:
no authentication, timestamps of the program, and the newest midpoint as the offset, without a bound
(RFC 5905).
"""

import select
import socket
import struct
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from functools import partial
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from benchmarks.programs import in_new_process, set_options
from benchmarks.report import ZERO, Goal, MeasurementError, Row, announce, benchmark
from benchmarks.rounds import Figures, Rounds, quantiles_us
from noack.runtime.address import Address
from noack.runtime.drivers.realtime_settings import realtime
from noack.runtime.host_clocks.clock_offset import ClockOffset
from noack.runtime.host_clocks.time_exchange import TimeClient, TimeReference, answering
from tests.helpers.run_by_hand import RunByHand
from tests.helpers.two_hosts import DrivenClocks, TwoHosts, enter_namespace, two_hosts

KEY = bytes(range(32))
CHECKS_AT_ONCE = 25
_FIFO_PRIORITY = 40
_WAKE_S = 0.001
_START_NS, _LENGTH_NS = 500_000_000, 6_000_000_000
"""Time of an exchange before it is checked, and while it is."""
_PACKET = struct.Struct("<qqq24x")  # 48 bytes, as NTP's
Clock = tuple[int, int]
"""How far the client's clock is ahead, ns, and its drift, ppb."""


class BareReference(socket.socket):
    """The answering end of a plain NTP exchange."""

    def __init__(self, at: Address) -> None:
        super().__init__(type=socket.SOCK_DGRAM)
        self.bind(at)
        self.address: Address = self.getsockname()

    def answer_all(self) -> None:
        """Answer the waiting request."""
        data, source = self.recvfrom(100)
        received_ns = time.monotonic_ns()
        sent_ns = _PACKET.unpack(data)[0]
        self.sendto(_PACKET.pack(sent_ns, received_ns, time.monotonic_ns()), source)


class BareClient(socket.socket):
    """The asking end of a plain NTP exchange, which takes the newest midpoint for the offset."""

    def __init__(self, to: Address, clocks: DrivenClocks) -> None:
        super().__init__(type=socket.SOCK_DGRAM)
        self.connect(to)
        self.setblocking(False)
        self.midpoint_ns: int | None = None
        self._clocks = clocks

    def poll(self) -> None:
        """Take the answer, or send a request if there is none."""
        try:
            data = self.recv(100)
        except BlockingIOError:
            self.send(_PACKET.pack(self._clocks.monotonic_ns(), 0, 0))
            return
        now_ns = self._clocks.monotonic_ns()
        sent_ns, there_ns, answered_ns = _PACKET.unpack(data)
        self.midpoint_ns = (there_ns - sent_ns + answered_ns - now_ns) // 2


class ClockCase(NamedTuple):
    """A setting of the client and of the reference, and the goal of the bound's error."""

    name: str
    goal: Goal | None = None
    period_s: float = 0.02
    late: bool = False
    """Whether the client reads replies once a period only."""
    rate_ppb: int = ClockOffset().rate_ppb
    answer_every_s: float = 0.0
    """Seconds between two answers; 0: at once."""


def answer(hosts: TwoHosts, case: ClockCase, bare: bool, parent: Connection) -> None:
    """Send the port to the parent, and answer until it closes its end."""
    enter_namespace(hosts.names[0])
    listen = (hosts.addresses[0][0], 0)
    end = BareReference(listen) if bare else TimeReference(listen, KEY)
    with closing(end), realtime(True, _FIFO_PRIORITY):
        parent.send(end.address[1])
        if isinstance(end, TimeReference) and not case.answer_every_s:
            with answering(end):
                parent.poll(None)
            return
        while not parent.poll(case.answer_every_s):
            while select.select([end], (), (), 0 if case.answer_every_s else 0.1)[0]:
                end.answer_all()


def ask(hosts: TwoHosts, case: ClockCase, bare: bool, port: int, clock: Clock) -> Figures:
    """Check the bound against the true offset for a time; return the figures."""
    enter_namespace(hosts.names[1])
    clocks, address = DrivenClocks(*clock), (hosts.addresses[0][0], port)
    offset, period_ns = ClockOffset(case.rate_ppb), round(case.period_s * 1e9)
    bare_client = BareClient(address, clocks) if bare else None
    client = bare_client or TimeClient(address, KEY, offset, period_ns=period_ns, clocks=clocks)
    errors_ns, estimates_ns = list[int](), list[int]()
    checks = outside = turns = cpu_ns = due_ns = 0
    steady_ns = time.monotonic_ns() + _START_NS
    end_ns = steady_ns + _LENGTH_NS
    with closing(client), realtime(True, _FIFO_PRIORITY):
        while (now_ns := time.monotonic_ns()) < end_ns:
            # Ask once a period; read the answer at once, or a period later.
            is_due = now_ns >= due_ns
            readable, _, _ = select.select([client], (), (), 0 if is_due else _WAKE_S)
            if is_due or (readable and not case.late):
                begin_ns = time.thread_time_ns()
                client.poll()
                cpu_ns += time.thread_time_ns() - begin_ns
            if is_due:
                due_ns, turns = max(due_ns, now_ns - period_ns) + period_ns, turns + 1
            # Compare the bound and the estimate with the true offset, which is −added_ns.
            for _ in range(CHECKS_AT_ONCE):
                true_ns = time.monotonic_ns()
                added_ns = clocks.added_ns(true_ns)
                bounds = offset.interval(true_ns + added_ns)
                if bounds is not None:
                    checks += 1
                    outside += not bounds.lower_ns <= -added_ns <= bounds.upper_ns
                    if true_ns > steady_ns:
                        errors_ns.append(bounds.error_ns)
                estimate_ns = bounds and bounds.midpoint_ns
                if bare_client is not None:
                    estimate_ns = bare_client.midpoint_ns
                if estimate_ns is not None and true_ns > steady_ns:
                    estimates_ns.append(abs(estimate_ns + added_ns))
    figures = {"checks": checks, "outside": outside, "cpu_us": cpu_ns / 1e3 / max(turns, 1)}
    for name, values_ns in (("error", errors_ns), ("estimate", estimates_ns)):
        if values_ns:
            figures |= {f"{name}_{quantile}": us for quantile, us in quantiles_us(values_ns).items()}
    return figures


def measured(hosts: TwoHosts, clock: Clock, case: ClockCase, *, bare: bool = False) -> Figures:
    """Run a reference and a client on two hosts; return the client's figures."""
    context = get_context("spawn")
    own, other = context.Pipe()
    reference = context.Process(target=answer, args=(hosts, case, bare, other))
    reference.start()
    other.close()
    with own:
        try:
            port = own.recv()
        except EOFError:
            raise MeasurementError("the reference did not start") from None
        figures = in_new_process(ask, hosts, case, bare, port, clock)
    reference.join()
    return figures


OURS, BARE = "noack", "plain NTP midpoint, no bound"
MAIN = ClockCase("20 ms, replies read at once", Goal("<=", 50))
CASES = (
    ClockCase("50 ms, replies read at once", period_s=0.05),
    ClockCase("50 ms, replies read 50 ms later", period_s=0.05, late=True),
    ClockCase("50 ms, replies read 50 ms later, ρ = 201 ppm", Goal("<=", 50), 0.05, True, 201_000),
    ClockCase("20 ms, reference answers every 50 ms", answer_every_s=0.05),
)
CLOCKS = [(ahead_s * 10**9, drift) for ahead_s in (1, -1) for drift in (100_000, -100_000)]


@benchmark("clock_offset_bound", "Bound of the offset between two clocks")
def clock_offset_bound() -> Iterator[Row]:
    """Measure both sides in turn with each clock, then the other settings, with real-time settings."""
    rounds, alternatives = Rounds(), [(case, Rounds()) for case in CASES]
    with two_hosts() as hosts:
        for clock in CLOCKS:
            announce("client {:+d} ns, {:+d} ppb".format(*clock))
            rounds.add(BARE, measured(hosts, clock, MAIN, bare=True))
            rounds.add(OURS, measured(hosts, clock, MAIN))
        for case, own in alternatives:
            announce(case.name)
            own.add(OURS, measured(hosts, CLOCKS[0], case))
    cases = [(MAIN, rounds), *alternatives]
    checks, outside = (sum(sum(own.values(OURS, name)) for _, own in cases) for name in ("checks", "outside"))
    yield Row("checks of the bound against the true offset", checks, "", goal=Goal(">=", 1e5))
    yield Row("true offset outside the bound", outside, "", goal=ZERO)
    for case, own in cases:
        for quantile in ("p50", "p99"):
            name = f"error bound, {quantile}, {case.name}"
            yield own.row(name, "µs", f"error_{quantile}", OURS, goal=case.goal)
    for quantile in ("p50", "p99"):
        name = f"error of the estimate, {quantile}"
        yield rounds.row(name, "µs", f"estimate_{quantile}", OURS, BARE)
    yield rounds.row("client's CPU per 20 ms", "µs", "cpu_us", OURS, BARE)


ROUNDS = 3
ACROSS, ON_LOOPBACK = "noack across a veth link", "noack on loopback"
_CHANGES = ("horizon_s=10", "trigger.beta=1e-9", 'network.loss={model="lossless"}')


def run_by_hand(hosts: TwoHosts | None) -> Figures:
    """Return the latency of a run with the controller on the second host, or all on this one."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        run = RunByHand(stack, Path(folder), hosts, *set_options(*_CHANGES)).finish()
    if run.status:
        raise MeasurementError(run.stderr.strip().splitlines()[-1])
    latency_us = run.summary["loops"][0]["latency_us"]
    return {key: latency_us[key] for key in ("p50", "p99", "updates")}


@benchmark("hosts", "The loop across two hosts")
def across_hosts() -> Iterator[Row]:
    """Compare the loop with the controller on the second host with the same processes on loopback."""
    rounds = Rounds()
    with two_hosts() as hosts:
        sides = {ON_LOOPBACK: partial(run_by_hand, None), ACROSS: partial(run_by_hand, hosts)}
        rounds.measure_in_turn(ROUNDS, sides)
    note = f"{sum(rounds.values(ACROSS, 'updates')):.0f} updates"
    for quantile in ("p50", "p99"):
        name, goal = f"event → update, {quantile}", Goal("<=", 1.5)
        yield rounds.row(name, "µs", quantile, ACROSS, ON_LOOPBACK, goal, note=note, paired=True)
