"""``noack netem shell``: a command whose IP packets all pass a link, as in mahimahi's shells.

The command runs in a network namespace with one device. The relay of :mod:`netem.relay.relay` reads its
packets there and writes them to a device outside, and the other way round.
"""

import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from netem.core.command_line import Signals, log_format
from netem.core.errors import CallerError, ExitStatus
from netem.core.system_processes import python_command
from netem.emulator_options import parse_options, shell_parser, shell_spec, timetable_of
from netem.relay.relay_links import DeviceLink
from netem.relay.relay_reports import report_line
from netem.shell import process
from netem.shell.devices import inside, open_devices
from netem.stand_alone import add_relay_options, check_options, report_totals, run_relay

_ENDS_S = 10.0
"""More than the time that a guard gives the processes of its command to end."""


def run_in_shell(arguments: Sequence[str]) -> int:
    """Run a command in a shell; return the command's exit status.

    Raises:
        CallerError: the command line has a mistake, or the system does not permit a shell.
    """
    words, command = list(arguments), []
    if "--" in words:
        index = words.index("--")
        words, command = words[:index], words[index + 1 :]
    parser = shell_parser()
    add_relay_options(parser, shell=True)
    options = parse_options(parser, words)
    spec = shell_spec(options)
    timetable = timetable_of(options, [spec])
    check_options(options)
    command = command or [os.environ.get("SHELL") or "/bin/sh"]
    outside = [_split(text) for text in options.outside or ()]
    for argv in (command, *outside):
        if shutil.which(argv[0]) is None:
            raise CallerError(f"{argv[0]}: there is no such program")
    with log_format(options.log_format):
        program = _Program(open_devices(spec), command, outside)
        totals = run_relay([program.devices.spec], options, program, timetable)
        report_totals(totals, options)
    return program.status


def _split(text: str) -> list[str]:
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise CallerError(f"--outside {text}: {error}") from None
    if not words:
        raise CallerError("--outside: needs a command")
    return words


class _Program:
    """The command of a shell, and those outside; the relay runs within :meth:`running`."""

    def __init__(self, devices: DeviceLink, command: Sequence[str], outside: Sequence[Sequence[str]]) -> None:
        self.devices = devices
        self._command, self._outside = command, outside
        self.status: int = ExitStatus.FAILED
        """The exit status of the command after the context."""

    @contextmanager
    def running(self, signals: Signals) -> Iterator[Callable[[], bool]]:
        """Run the commands within the context; yields whether the command has ended.

        Ctrl-C is for the command, to which the terminal sends it, too.
        """
        spec = self.devices.spec
        addresses = {"NOACK_OUTSIDE": spec.to[0]}
        if self.devices.outside6 is not None:
            addresses["NOACK_OUTSIDE6"] = self.devices.outside6
        with self._start_all(addresses) as main:
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            ends = f"inside {spec.listen[0]}, outside {' and '.join(addresses.values())}"
            report_line(f"{ends}; the emulator is process {os.getpid()}")
            yield lambda: main.poll() is not None
        returncode = -signal.SIGKILL if main.returncode is None else main.returncode
        self.status = returncode if returncode >= 0 else 128 - returncode
        if signals.received is not None:
            self.status = signals.status

    @contextmanager
    def _start_all(self, addresses: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
        """Start the commands, and end them after the context, or if one cannot start.

        Yields the command inside.
        """
        earlier_children = process.children(os.getpid())
        process.adopt_orphans()
        programs: list[subprocess.Popen[bytes]] = []
        try:
            programs.extend(_start(command) for command in self._outside)
            with inside(self.devices):
                namespace = os.fstat(self.devices.namespace).st_ino
                programs.append(_start(self._command, addresses, namespace))
            yield programs[-1]
        finally:
            for program in programs:
                program.terminate()
            for program in programs:
                with suppress(subprocess.TimeoutExpired):  # end_children kills it
                    program.wait(_ENDS_S)
            process.end_children(earlier_children)  # of a guard that was killed


def _start(
    command: Sequence[str], variables: dict[str, str] | None = None, namespace: int = 0
) -> subprocess.Popen[bytes]:
    guard = python_command("-IS", process.__file__, "inside", os.getpid(), namespace)
    return subprocess.Popen([*guard, *command], env=os.environ | (variables or {}))
