"""The processes of a shell, as a program of their own, which starts quickly without noack.

``outside ARGUMENTS``: becomes a user of its own namespaces, in which it may open devices, and
then the program of the arguments. ``inside PARENT NAMESPACE ARGUMENTS``: runs the program, and ends
all processes that it started when it ends or when the parent does; even if this process and its
parent are killed, those in the network namespace of this number, if it is not 0.
"""

import ctypes
import os
import signal
import struct
import sys
import time
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path

NEW_USER, NEW_NETWORK = 0x10000000, 0x40000000
"""Flags of unshare and setns: CLONE_NEWUSER, CLONE_NEWNET."""
NOT_FOUND = 127
"""Exit status of a shell whose program cannot be started."""
_DEATH_SIGNAL, _SUBREAPER, _AMBIENT = 1, 36, 47
"""Requests of prctl: PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER, PR_CAP_AMBIENT."""
_AMBIENT_RAISE = 2
_CAPABILITIES, _VERSION = 41, 0x20080522
"""Number of capabilities of Linux, and the version of the structures of capset."""
_GRACE_S = 2.0
"""From SIGTERM to SIGKILL."""
_POLL_S = 0.01


def call(function: str, *arguments: object) -> None:
    """Call a function of libc.

    Raises:
        OSError: it fails.
    """
    if getattr(ctypes.CDLL(None, use_errno=True), function)(*arguments) != 0:
        error = ctypes.get_errno()
        raise OSError(error, os.strerror(error), function)


def adopt_orphans() -> None:
    """Become the parent of all descendants whose parents end."""
    call("prctl", _SUBREAPER, 1, 0, 0, 0)


def enter_namespaces() -> None:
    """Enter a new user namespace, with the same user, and a new network namespace.

    All programs that this process becomes or starts may administer them.

    Raises:
        OSError: the system does not permit it.
    """
    user, group = os.getuid(), os.getgid()
    call("unshare", NEW_USER | NEW_NETWORK)
    for name, text in (
        ("setgroups", "deny"),
        ("uid_map", f"{user} {user} 1"),
        ("gid_map", f"{group} {group} 1"),
    ):
        Path("/proc/self", name).write_text(text)
    head = ctypes.create_string_buffer(struct.pack("=Ii", _VERSION, 0))
    sets = ctypes.create_string_buffer(24)
    call("capget", head, sets)
    words = list(struct.unpack("=6I", sets.raw[:24]))  # effective, permitted, inheritable; twice
    words[2], words[5] = words[1], words[4]
    call("capset", head, struct.pack("=6I", *words))
    for capability in range(_CAPABILITIES):
        with suppress(OSError):  # the kernel has fewer
            call("prctl", _AMBIENT, _AMBIENT_RAISE, capability, 0, 0)


def children(parent: int) -> set[int]:
    """Return the process ids of a process's children."""
    ids = set()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended
            state = (process / "stat").read_bytes().rpartition(b")")[2]
            if int(state.split()[1]) == parent:
                ids.add(int(process.name))
    return ids


def end_children(kept_processes: Collection[int] = ()) -> None:
    """End all children and adopted descendants but ``kept_processes``: by SIGTERM, then by SIGKILL."""
    deadline_s = time.monotonic() + _GRACE_S
    terminated: set[int] = set()
    while remaining := children(os.getpid()).difference(kept_processes):
        is_overdue = time.monotonic() > deadline_s
        for child in remaining if is_overdue else remaining - terminated:
            os.kill(child, signal.SIGKILL if is_overdue else signal.SIGTERM)
            os.kill(child, signal.SIGCONT)  # a stopped process, too
        terminated |= remaining
        for child in remaining:
            with suppress(ChildProcessError):
                os.waitpid(child, os.WNOHANG)
        time.sleep(_POLL_S)


def in_namespace(namespace: int) -> set[int]:
    """Return the process ids in the network namespace of this number."""
    ids = set()
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it has ended, or is another user's
            if (process / "ns" / "net").stat().st_ino == namespace:
                ids.add(int(process.name))
    return ids


def start_warden(namespace: int) -> int:
    """Start a process that outlives this one, and then kills all that is in a network namespace.

    It sees the end of this process by a pipe, of which no other process has the end.
    """
    reading, _ = os.pipe()  # programs that are started do not inherit it
    warden = os.fork()
    if warden > 0:
        os.close(reading)
        return warden
    os.setsid()  # what kills the whole group does not kill this process
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in range(256):  # also the end of the pipe
        if descriptor not in (reading, null):
            with suppress(OSError):
                os.close(descriptor)
    os.read(reading, 1)
    while others := in_namespace(namespace) - {os.getpid()}:
        for process in others:
            with suppress(OSError):
                os.kill(process, signal.SIGKILL)
        time.sleep(_POLL_S)
    os._exit(0)


def guard(parent: int, namespace: int, command: list[str]) -> int:
    """Run a command; return its exit status when all processes that it started have ended."""
    # Signals that end the command wait until they are asked for; those of the terminal are its own.
    ending = {signal.SIGTERM, signal.SIGHUP}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {*ending, signal.SIGCHLD})
    handlers = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGQUIT)}
    adopt_orphans()
    group = os.getpgrp()
    os.setpgid(0, 0)  # what kills the whole group does not kill this process
    call("prctl", _DEATH_SIGNAL, signal.SIGTERM, 0, 0, 0)
    wardens = {start_warden(namespace)} if namespace else set()
    # The command, in the terminal's group and with the signals as they were.
    child = os.fork()
    if child == 0:
        with suppress(OSError):  # the group has ended
            os.setpgid(0, group)
        call("prctl", _DEATH_SIGNAL, signal.SIGKILL, 0, 0, 0)
        for number, handler in handlers.items():
            signal.signal(number, handler if handler is signal.SIG_IGN else signal.SIG_DFL)
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        try:
            os.execvp(command[0], command)
        except OSError as error:
            os.write(2, f"noack-netem: {command[0]}: {error.strerror}\n".encode())
            os._exit(NOT_FOUND)
    # Wait for the command's end, a signal, or the parent's end.
    status = None
    while status is None and os.getppid() == parent:
        if signal.sigwait({*ending, signal.SIGCHLD}) in ending:
            status = 128 + signal.SIGTERM
            break
        with suppress(ChildProcessError):
            while (reaped := os.waitpid(-1, os.WNOHANG))[0]:
                if reaped[0] == child:
                    status = os.waitstatus_to_exitcode(reaped[1])
    end_children(wardens)
    return 1 if status is None else status if status >= 0 else 128 - status


def main() -> None:
    """Run the role that the first argument names."""
    role, *arguments = sys.argv[1:]
    if role == "inside":
        sys.exit(guard(int(arguments[0]), int(arguments[1]), arguments[2:]))
    with suppress(OSError):  # the program will report that it is not permitted
        enter_namespaces()
    os.execv(arguments[0], arguments)


if __name__ == "__main__":
    main()
