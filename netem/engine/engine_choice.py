"""Opens a relay with the fastest engine that there is."""

import importlib.util
import platform
import sys
from collections.abc import Sequence
from typing import Literal

from netem.engine.plain_engine import PlainRelay
from netem.engine.relay_interface import LinkSpec, Relay, Tap
from noack.core.errors import CallerError

Engine = Literal["auto", "batched", "plain"]


def open_relay(
    specs: Sequence[LinkSpec],
    engine: Engine = "auto",
    segment: bool = False,
    taps: Sequence[Tap] = (),
    spin_ns: int = 0,
) -> Relay:
    """Bind the sockets of all links; the relay runs when :meth:`Relay.run` is called.

    Args:
        specs: the links, at least one.
        engine: ``batched`` is the fast one, for Linux; ``plain`` runs everywhere; ``auto`` takes
            the fast one where it is to be had.
        segment: let runs of datagrams of equal size leave as one message that the kernel cuts,
            where it does. The plain engine does not.
        taps: what sees everything that the relay does.
        spin_ns: do not sleep for so long before a delayed datagram is due; it then leaves sooner
            than a sleeper wakes. The plain engine sleeps.

    Raises:
        CallerError: a socket cannot be bound, a link makes no sense, or the engine is not to be had
            here.
    """
    missing = compiled_engine_is_missing()
    if engine == "batched" and missing:
        raise CallerError(f"the batched engine {missing}; use the plain one")
    if engine == "plain" or missing:
        return PlainRelay(specs, taps)
    from netem.engine.batched_engine import BatchedRelay, load

    load()
    return BatchedRelay(specs, segment, taps, spin_ns)


def compiled_engine_is_missing() -> str:
    """Why there is no fast engine; empty if there is."""
    if (
        sys.platform != "linux"
        or sys.byteorder != "little"
        or platform.architecture()[0] != "64bit"
    ):
        return "runs on 64-bit Linux only"
    if importlib.util.find_spec("numba") is None:
        return "needs numba, which is not installed"
    return ""
