"""Packet traces from the delivery opportunities of mahimahi: what a periodic probe would meet.

Such a file says when the link could deliver, and nothing about losses. So the trace is that of a
simulated probe through the emulator's link with these opportunities: its delays are those of
waiting for the next opportunity.
"""

import re
from pathlib import Path

import numpy as np

from netem.link_state import LinkState
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.impairments.kinds.opportunities import OPPORTUNITY_BYTES, Opportunities
from noack.impairments.link_settings import NEVER_NS, LinkSettings
from noack.traces.packet_trace import LOST_NS, PacketTrace, packet_trace

_LINES = re.compile(rb"(?:[0-9]{1,15}[ \t]*\r?\n)+[0-9]{0,15}")
_PROBE_BYTES = 100
_MOST_PROBES = 5_000_000


def is_opportunity_file(head: bytes) -> bool:
    """Whether a file begins with lines of one whole number each."""
    return _LINES.fullmatch(head) is not None


def read_opportunities(path: Path, period_ns: int) -> PacketTrace:
    """Return the trace of a probe with this period, for as long as the file.

    Raises:
        CallerError: one line; the file cannot be read, or is wrong.
    """
    read = Opportunities(file=str(path.absolute())).without_files(Path("/"), "")
    times_ms = np.array(read.times_ms)
    probes = read.length_ns // period_ns
    if not 1 <= probes <= _MOST_PROBES:
        raise CallerError(
            f"{path}: {read.length_ns / 1e9:g} s are {probes} datagrams of the simulated probe; "
            f"expected 1 to {_MOST_PROBES}; choose another --rate"
        )
    link = LinkState(LinkSettings(impairments=(read,), mansd=None), 0, "link", "forward")
    link.start_flow(0, 0)
    sent_ns = np.arange(probes) * period_ns
    received_ns = np.full(probes, LOST_NS)
    for k, at_ns in enumerate(sent_ns.tolist()):
        release_ns = link.decide(0, _PROBE_BYTES, at_ns).release_ns
        if release_ns != NEVER_NS:
            received_ns[k] = release_ns
    rate_bps = len(times_ms) * OPPORTUNITY_BYTES * 8 * NS_PER_S / read.length_ns
    gaps_ms = np.diff(times_ms, prepend=0)
    k = int(gaps_ms.argmax())
    return packet_trace(sent_ns, received_ns, received_ns == LOST_NS).noted(
        f"delivery opportunities of mahimahi: {len(times_ms)} in {read.length_ns / 1e9:g} s, "
        f"{rate_bps / 1e6:.4g} Mbit/s; longest time without one: {gaps_ms[k]} ms, "
        f"before {times_ms[k] / 1e3:g} s",
        f"they say nothing about losses: this is a simulated probe, {_PROBE_BYTES} bytes every "
        f"{period_ns / 1e6:g} ms, through a link with them",
    )
