"""Decisions for many datagrams at once, without sockets: for tests, planning and benchmarks."""

from collections.abc import Sequence

from netem.rule_records import PacketDecision
from netem.rules.link_rules import LinkMemory, LinkProgram, admit


def admit_many(
    program: LinkProgram,
    state: LinkMemory,
    flows: Sequence[int],
    sizes_bytes: Sequence[int],
    arrivals_ns: Sequence[int],
    verdicts: Sequence[PacketDecision],
) -> None:
    """Decide what becomes of k datagrams, in the order of their arrival; see :func:`admit`."""
    for number in range(len(flows)):
        admit(
            program, state, flows[number], sizes_bytes[number], arrivals_ns[number],
            verdicts[number],
        )  # fmt: skip
