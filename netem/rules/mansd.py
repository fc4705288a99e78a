"""The guarantee: of successive datagrams of a flow at most M − 1 are not effectively delivered.

MANSD is the maximum allowable number of successive dropouts (Garcia & Antsaklis, Section III). A
datagram is *effectively delivered* if it, or a copy of it, leaves intact and before every later
datagram of its flow: whatever is dropped, corrupted, or overtaken (stale, for a receiver that wants
the newest) is not. Hence two rules:

* When M − 1 in a row are not delivered, the next must pass (:func:`must_pass`).
* A datagram may overtake earlier ones, but not so many that more than M − 1 in a row are stale: it
  is held back until one that is needed has left (:func:`needed_until_ns`). The releases of the
  datagrams that count as delivered therefore ascend, so that what is held back behind one of them
  is behind all before it.
"""

from collections.abc import MutableSequence, Sequence

from netem.rule_records import FlowState

NEVER_NS = -1


def must_pass(flow: FlowState, mansd: int) -> bool:
    """Whether the next datagram has to be delivered.

    Args:
        flow: its state.
        mansd: M − 1, or −1 for no cap.
    """
    return flow.forced_first != 0 or (mansd >= 0 and flow.run >= mansd)


def needed_until_ns(flow: FlowState, recent_ns: Sequence[int], mansd: int, packet: int) -> int:
    """When the datagram leaves that ``packet`` must not overtake; −1 if there is none.

    Args:
        flow: its state.
        recent_ns: ring of mansd + 1 release times of the datagrams before, −1 for those that are
            not effectively delivered.
        mansd: M − 1, or −1 for no cap: then only the first datagram of a flow may be needed.
        packet: number of the datagram in its flow.
    """
    needed_ns = flow.first_release_ns
    oldest = packet - 1 - mansd
    if mansd >= 0 and oldest >= 0:
        width = mansd + 1
        for number in range(oldest, packet):
            if recent_ns[number % width] >= 0:
                return max(needed_ns, recent_ns[number % width])
    return needed_ns


def overtake(recent_ns: MutableSequence[int], mansd: int, packet: int, release_ns: int) -> int:
    """Mark as stale what ``packet``, leaving at ``release_ns``, overtakes; return how many."""
    width = mansd + 1
    delivered_out_of_order = 0
    for number in range(max(packet - width, 0), packet):
        if recent_ns[number % width] > release_ns:
            recent_ns[number % width] = NEVER_NS
            delivered_out_of_order += 1
    return delivered_out_of_order
