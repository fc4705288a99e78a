"""The driver of a machine that is a program of its own, which does what the core's driver does.

The program is started before the start barrier, and gets the sockets of the process with its
settings: then noack is no longer in the path of the loop. It returns rows of the record and counts,
by frames (``enum noack_node_frame`` in native/noack.h, docs/node.md). Their place is the core's
process of the same loop, so that everything else is as with the core's own driver.

The program ends when its standard input does, and is killed if this process dies. What it has
started itself is killed with it at the end of the run, as far as it stayed in its process group.
"""

import ctypes
import os
import select
import signal
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Self

from noack.controllers.program_controller import ProgramControllerSettings
from noack.core.clock import NS_PER_S, RunClock
from noack.core.core_library import core, ffi
from noack.core.errors import CallerError, PeerError, shortened
from noack.machines.loop_machines import LoopMachines
from noack.protocol.roles import SENDS
from noack.runtime.address import Address, SocketName
from noack.runtime.drivers.live_driver import LiveDriver, LoopSockets, ends_of
from noack.runtime.drivers.real_time_loop import RecordSink
from noack.runtime.run_process import RunProcess
from noack.settings.user_files import checked_path

_PR_SET_PDEATHSIG = 1
_LONGEST_WAIT_S = 10.0
"""Longest wait for the program's first line, and for its end."""
_STUCK_S = 1.0
"""A program that is late has stopped its ticks if the last one came longer ago than this."""
_GREETING_BYTES = 200
"""Longest first line of a program."""
_READ_BYTES = 2**20
_READS = 16
"""Most reads of this size at once: a program may send faster than its frames are processed."""
_LOOK_S = 0.05
"""Longest time between two looks at the reasons to stop."""
_ROWS = (core.NOACK_TICKS, core.NOACK_MESSAGES)
"""The kinds of frames with a row of the record."""
_COPIED_FIELDS = (
    *("has_point", "acknowledges", "predictions", "carries_model", "timeout_ns", "holds_input"),
    *("model_ns", "has_state", "newest"),
)
"""Fields of a ``noack_controller`` that the settings of a node have, too."""
_HEAD = struct.Struct("<qq")
_GREETING = f"noack node {core.NOACK_NODE_VERSION} {ffi.sizeof('noack_node_settings')}"


def run_program(process: RunProcess, machines: LoopMachines, settings: ProgramControllerSettings) -> None:
    """Join the run, let a program drive its controller to the horizon, and report.

    Raises:
        CallerError: it is no program of this version, or the process's port is taken.
        PeerError: the run never started, or the program ended before the run.
    """
    with process.open_socket() as endpoint, NodeDriver(process, machines, settings) as driver:
        addresses = process.join(endpoint.getsockname()[:2])
        sockets = LoopSockets(endpoint, driver, SENDS[process.role], **ends_of(process, addresses))
        process.run(driver, sockets, machines)


class NodeDriver(LiveDriver):
    """Starts the program, and is its peer; a context, with which the program ends."""

    def __init__(
        self, process: RunProcess, machines: LoopMachines, settings: ProgramControllerSettings
    ) -> None:
        super().__init__(machines, process.wire)
        # The file's name alone: the process is given a copy in the run directory.
        self._label = f"controller.file ({Path(settings.file).name})"
        self._key, self._sockets = process.descriptor.key, list[socket.socket]()
        self._clock, self._sent_clock = RunClock(0), b""
        self._to_send, self._received = bytearray(), bytearray()
        self._unknown_source, self._tick_s = 0, time.monotonic()
        self._is_closed = False
        tables = machines.core.tables
        rows = {kind: tables[kind].row_bytes - core.NOACK_LOOP_BYTES for kind in _ROWS}
        counts = ffi.sizeof("noack_node_counts")
        self._sizes = rows | {core.NOACK_NODE_COUNTS: counts, core.NOACK_NODE_UNSENT: 8}
        self._stream, peer = socket.socketpair()
        peer.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _READ_BYTES)  # this process may stall
        with peer:
            self._program = self._start(checked_path(settings, "controller"), settings.runner, peer)

    def _start(self, path: Path, runner: Sequence[str], peer: socket.socket) -> "subprocess.Popen[bytes]":
        prctl: Callable[[int, int], int] = ctypes.CDLL(None).prctl
        try:
            return subprocess.Popen(
                [*runner, str(path)],
                stdin=peer.fileno(),
                stdout=peer.fileno(),
                process_group=0,
                # Not only the end of its input: the program may hang, or be stopped.
                preexec_fn=partial(prctl, _PR_SET_PDEATHSIG, signal.SIGKILL),
            )
        except OSError as error:
            self._stream.close()
            if runner:
                raise CallerError(
                    f'controller.runner = "{runner[0]}": cannot be started: {error.strerror}'
                ) from None
            raise CallerError(
                f"{self._label}: cannot be started: {error.strerror}; it must be executable (chmod "
                "+x), and of this processor, or controller.runner names what runs it"
            ) from None

    def __enter__(self) -> Self:
        """Wait for the program's first line; raise CallerError if it is not that of a node."""
        text = self._first_line().decode(errors="replace").strip()
        if text != _GREETING:
            answer = f"says {shortened(text)!r}" if text else self._how_it_ended()
            self.__exit__()
            raise CallerError(
                f"{self._label}: {answer}; a node of this version says {_GREETING!r}: build it by "
                "native/build.py --node"
            )
        self._stream.setblocking(False)
        return self

    def _first_line(self) -> bytes:
        line, until_s = b"", time.monotonic() + _LONGEST_WAIT_S
        with suppress(TimeoutError):
            while not line.endswith(b"\n") and len(line) < _GREETING_BYTES:
                self._stream.settimeout(max(until_s - time.monotonic(), 1e-6))
                if not (byte := self._stream.recv(1)):
                    self._is_closed = True
                    break
                line += byte
        return line

    def __exit__(self, *_: object) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._program.pid, signal.SIGKILL)
        self._program.wait()
        self._stream.close()

    def open(
        self,
        senders: Sequence[socket.socket],
        receivers: Sequence[socket.socket],
        sources: Sequence[Address],
    ) -> None:
        """Let the program use these sockets from now on."""
        super().open(senders, receivers, sources)
        self._sockets, self._source = [receivers[0], senders[0], senders[-1]], sources[0]

    def set_clock(self, clock: RunClock) -> None:
        """Let the program read the time as this clock does; the first time, it begins."""
        super().set_clock(clock)
        self._clock, clock_bytes = clock, bytes(ffi.buffer(ffi.addressof(self.core, "clock")))
        if not self._sent_clock:
            data = self._settings()
            first = _HEAD.pack(core.NOACK_NODE_SETTINGS, len(data))
            with suppress(BrokenPipeError):  # drive() finds that it has ended
                socket.send_fds(self._stream, [first[:1]], [endpoint.fileno() for endpoint in self._sockets])
            self._to_send += first[1:] + data
        elif clock_bytes != self._sent_clock:
            self._queue_message(core.NOACK_NODE_CLOCK, clock_bytes)
        self._sent_clock = clock_bytes

    def _settings(self) -> bytes:
        controller = self.machines.machines[0]
        n, m, model = controller.machine.n, controller.machine.m, controller.model
        numbers = {name: getattr(controller, name) for name in _COPIED_FIELDS} | {
            "run_id": self.core.wire.run_id,
            "key": self._key,
            "clock": self.core.clock,
            "machine": controller.machine,
            "is_static": model.transitions.is_static,
        }
        arrays = (
            (model.transitions.H, n * n),
            (controller.K, m * n),
            (controller.x_r, n),
            (controller.u_r, m),
            (controller.safe_input, m),
            (controller.x_c, n),
        )
        settings = ffi.new("noack_node_settings *", numbers)
        return bytes(ffi.buffer(settings)) + b"".join(
            bytes(ffi.buffer(array, 8 * size)) if array else bytes(8 * size) for array, size in arrays
        )

    def drive(self, until_ns: int, sink: RecordSink) -> None:
        """Take what the program has done until about a time of the run."""
        goes_on, wait_s = True, 1.0
        while goes_on and wait_s > 0:
            wait_s = (until_ns - self._clock.now_ns()) / NS_PER_S / self._clock.speed
            goes_on = self._exchange(max(wait_s, 0.0))
            self._take_frames(sink)
        self._pass_rows(sink)
        if not goes_on:
            raise PeerError(f"{self._label}: {self._how_it_ended()}")

    def take(self, data: bytes, source: SocketName, sink: RecordSink) -> None:
        """Pass the program a datagram that Python has received."""
        from_peer = source[:2] == self._source
        if not from_peer:
            self.core.unknown_source += 1
        self._queue_message(core.NOACK_NODE_DATAGRAM, struct.pack("<q", from_peer) + data)

    def finish(self, sink: RecordSink) -> None:
        """Let the program end; take all that it has done.

        Raise PeerError if it does not end, or fails, or has stopped its ticks before the horizon.
        """
        began_s, now_ns, goes_on = time.monotonic(), self._clock.now_ns(), True
        until_s = began_s + _LONGEST_WAIT_S
        while goes_on and (wait_s := until_s - time.monotonic()) > 0:
            if not self._to_send:
                with suppress(OSError):  # it has ended
                    self._stream.shutdown(socket.SHUT_WR)
            goes_on = self._exchange(min(wait_s, _LOOK_S), select.POLLIN)
            self._take_frames(sink)
        self._pass_rows(sink)
        end_reason = self._how_it_ended()
        if goes_on or self._program.returncode != 0:
            raise PeerError(f"{self._label}: {end_reason}")
        due_ns = self.next_deadline_ns()
        late_s = 0.0 if due_ns is None else (now_ns - due_ns) / NS_PER_S / self._clock.speed
        if min(late_s, began_s - self._tick_s) > _STUCK_S:
            steps = self.machines.machines[0].machine.step
            raise PeerError(
                f"{self._label}: has sent {steps} ticks, and is {late_s:.1f} s late with the next; "
                "it must send the row of each tick"
            )

    def _queue_message(self, kind: int, content: bytes) -> None:
        self._to_send += _HEAD.pack(kind, len(content)) + content

    def _exchange(self, wait_s: float, wake: int = 0) -> bool:
        """Wait, then send and receive; return whether the program may send more.

        Its rows do not end the wait, unless ``wake`` is POLLIN: they would take time of its core.
        The program may have ended while another one, which it has started, keeps its stream.
        """
        poll = select.poll()
        poll.register(self._stream, wake | (select.POLLOUT if self._to_send else 0))
        poll.poll(1000 * wait_s)
        goes_on = self._program.poll() is None
        with suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            while self._to_send:
                del self._to_send[: self._stream.send(self._to_send)]
        try:
            for _ in range(_READS):
                if not (data := self._stream.recv(_READ_BYTES)):
                    self._is_closed = True
                    break
                self._received += data
        except BlockingIOError:
            return goes_on
        except ConnectionResetError:
            self._is_closed = True
        return not self._is_closed

    def _take_frames(self, sink: RecordSink) -> None:
        """Put the complete frames where the core's driver puts what they have."""
        begin, received = 0, bytes(self._received)
        while begin + _HEAD.size <= len(received):
            kind, size = _HEAD.unpack_from(received, begin)
            if size != self._sizes.get(kind):
                raise PeerError(
                    f"{self._label}: has sent a frame of kind {kind} and {size} bytes, which no "
                    "node of this version sends"
                )
            if len(received) < begin + _HEAD.size + size:
                break
            content = received[begin + _HEAD.size : begin + _HEAD.size + size]
            self._take_frame(kind, content, sink)
            begin += _HEAD.size + size
        del self._received[:begin]
        core.noack_process_begin(self.machines.core)  # its next tick

    def _take_frame(self, kind: int, content: bytes, sink: RecordSink) -> None:
        driver, machine = self.core, self.machines.machines[0].machine
        if kind == core.NOACK_NODE_UNSENT:
            (number,) = struct.unpack("<q", content)
            driver.errors[number % len(driver.errors)] += 1
        elif kind == core.NOACK_NODE_COUNTS:
            counts = ffi.from_buffer("noack_node_counts *", content)
            driver.sent, driver.sources[0].received = counts.sent, counts.received
            driver.unknown_source += counts.unknown_source - self._unknown_source
            self._unknown_source = counts.unknown_source
            machine.received.accepted = counts.accepted
            machine.received.rejected = counts.rejected
        else:
            table = driver.process.tables[kind]
            row = table.rows + table.count * table.row_bytes + core.NOACK_LOOP_BYTES
            ffi.memmove(row - core.NOACK_LOOP_BYTES, bytes(core.NOACK_LOOP_BYTES), 2)
            ffi.memmove(row, content, len(content))
            table.count += 1
            if kind == core.NOACK_TICKS:
                sequence = struct.unpack_from("<q", content, 8)[0]
                if sequence != (due := machine.step):
                    raise PeerError(f"{self._label}: has sent tick {sequence} in place of {due}")
                machine.step += 1
                self._tick_s = time.monotonic()
            if table.count == table.places:
                self._pass_rows(sink)

    def _how_it_ended(self) -> str:
        """Return how; or that it has not, after its stream has ended or after a wait for it."""
        try:
            code = self._program.wait(_LONGEST_WAIT_S if self._is_closed else 0.0)
        except subprocess.TimeoutExpired:
            if self._is_closed:
                return "the program has closed its stream, but has not ended"
            return f"the program has not answered for {_LONGEST_WAIT_S:g} s"
        end = f"exit status {code}"
        if code < 0:  # real-time signals have no names
            names = {number.value: number.name for number in signal.Signals}
            end = f"killed by {names.get(-code, f'signal {-code}')}"
        return f"the program has ended: {end}"
