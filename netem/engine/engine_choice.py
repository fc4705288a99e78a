"""Opens a relay with the fastest available engine."""

import importlib.util
import platform
import sys
from collections.abc import Sequence
from typing import Literal

from netem.engine.plain_engine import PlainRelay
from netem.engine.relay_base import Relay
from netem.engine.relay_interface import LinkSpec, Tap
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
        engine: ``batched`` is the fast engine, for Linux; ``plain`` runs everywhere; ``auto`` uses
            the fast engine if it is available.
        segment: send successive datagrams of equal size as one message, which the kernel segments,
            if the kernel supports it. The plain engine ignores this.
        taps: receivers of all events.
        spin_ns: busy-wait instead of sleeping for this time before a delayed datagram is due, to
            avoid the delay of a wake-up. The plain engine ignores this.

    Raises:
        CallerError: a socket cannot be bound, a link is invalid, or the engine is not available on
            this machine.
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
    """Return why the fast engine is not available; empty if it is available."""
    if (
        sys.platform != "linux"
        or sys.byteorder != "little"
        or platform.architecture()[0] != "64bit"
    ):
        return "runs on 64-bit Linux only"
    if importlib.util.find_spec("numba") is None:
        return "needs numba, which is not installed"
    return ""
