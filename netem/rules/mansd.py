"""The guarantee: at most M − 1 consecutive packets of a flow are not effectively delivered.

MANSD is the maximum allowable number of successive dropouts (Garcia & Antsaklis, Section III). A
packet is *effectively delivered* if it, or a copy of it, leaves intact and before every later
packet of its flow. A packet that is dropped, corrupted, or delivered out of order (stale, for a
receiver that wants the newest) is not. Hence two rules:

* After M − 1 consecutive losses, the next packet must pass (:func:`must_pass`).
* A packet may leave before earlier ones, but must not make more than M − 1 consecutive packets
  stale: it is held back until the needed earlier packet has left (:func:`needed_until_ns`).
  Therefore the release times of the packets that count as delivered ascend, and a packet held back
  behind one of them leaves after all earlier ones of them, too.
"""

from collections.abc import MutableSequence, Sequence

from noack.impairments.link_records import NEVER_NS, FlowState


def must_pass(flow: FlowState, mansd: int) -> bool:
    """Whether the next packet has to be delivered; ``mansd`` is M − 1, or −1 for no cap."""
    return flow.forced_first != 0 or (mansd >= 0 and flow.consecutive_losses >= mansd)


def needed_until_ns(flow: FlowState, recent_ns: Sequence[int], mansd: int, packet: int) -> int:
    """Return the time before which ``packet`` must not leave; −1 if there is none.

    It is the release time of the earlier packet that ``packet`` must not precede. ``recent_ns`` is
    a ring of the mansd + 1 previous packets' release times; −1 for packets that are not effectively
    delivered. Without a cap, only the first packet can be needed.
    """
    needed_ns = flow.first_release_ns
    oldest = packet - 1 - mansd
    if mansd >= 0 and oldest >= 0:
        width = mansd + 1
        for number in range(oldest, packet):
            if recent_ns[number % width] >= 0:
                return max(needed_ns, recent_ns[number % width])
    return needed_ns


def make_stale(recent_ns: MutableSequence[int], mansd: int, packet: int, release_ns: int) -> int:
    """Mark the earlier packets that leave after ``release_ns`` as stale; return how many."""
    width = mansd + 1
    stale = 0
    for number in range(max(packet - width, 0), packet):
        if recent_ns[number % width] > release_ns:
            recent_ns[number % width] = NEVER_NS
            stale += 1
    return stale
