"""Decisions for many packets at once, without sockets: for tests, planning and benchmarks."""

from collections.abc import Sequence

from netem.rules.link_rules import admit
from noack.impairments.link_records import LinkMemory, LinkProgram, PacketDecision


def admit_many(
    program: LinkProgram,
    state: LinkMemory,
    flows: Sequence[int],
    sizes_bytes: Sequence[int],
    arrivals_ns: Sequence[int],
    decisions: Sequence[PacketDecision],
) -> None:
    """Decide for k packets, in order of arrival; see :func:`admit`."""
    for number in range(len(flows)):
        admit(
            program, state, flows[number], sizes_bytes[number], arrivals_ns[number],
            decisions[number],
        )  # fmt: skip
