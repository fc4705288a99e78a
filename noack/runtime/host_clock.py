"""Which monotonic clock a process reads."""

import uuid
from contextlib import suppress
from pathlib import Path

_BOOT = Path("/proc/sys/kernel/random/boot_id")
_NAMESPACE = Path("/proc/self/ns/time")


def clock_identity() -> str:
    """Return a name of this process's monotonic clock; processes with the same name share it.

    On Linux the clock is that of the boot, with the offset of the time namespace. Elsewhere the
    name is a number of the machine.
    """
    with suppress(OSError):
        namespace = ""
        with suppress(OSError):  # a kernel before 5.6 has no time namespaces
            namespace = str(_NAMESPACE.readlink())
        return f"{_BOOT.read_text(encoding='ascii').strip()} {namespace}".strip()
    return f"machine {uuid.getnode():x}"
