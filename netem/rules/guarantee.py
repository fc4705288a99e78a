"""The guarantee: which packets of a flow may be lost, and which earlier ones they may make stale.

A packet is *effectively delivered* if it, or a copy of it, leaves intact and before every later
packet of its flow. A packet that is dropped, corrupted, or delivered out of order (stale, for a
receiver that wants the newest) is lost. The guarantee consists of

* the maximum of consecutive losses, M − 1 (MANSD: the maximum allowable number of successive
  dropouts; Garcia & Antsaklis, Section III),
* windows: at most m losses among any K consecutive packets,
* recovery: at least h consecutive deliveries between two loss bursts.

Each of them allows every delivery. Hence two rules (docs/mansd.md has the proof):

* A packet whose loss is not allowed after the losses before it must pass (:func:`must_pass`).
* A packet may leave before earlier ones only if the losses that this causes are allowed; else it is
  held back until it makes fewer stale (:func:`hold_back_until`).

S(i) is the number of losses among a flow's packets with numbers below i. Windows and recovery are
differences of S, which a ring stores per flow.
"""

from collections.abc import MutableSequence, Sequence

from noack.impairments.link_records import NEVER_NS, FlowState, LinkProgram


def counts_losses(program: LinkProgram) -> bool:
    """Whether the guarantee needs S."""
    return len(program.windows) > 0 or program.recovery > 0


def must_pass(program: LinkProgram, flow: FlowState, losses: Sequence[int]) -> bool:
    """Whether the next packet has to be delivered; ``losses`` is the ring of S."""
    if flow.forced_first != 0:
        return True
    if program.mansd >= 0 and flow.consecutive_losses >= program.mansd:
        return True
    if not counts_losses(program):
        return False
    packet, mask = flow.packets, len(losses) - 1
    so_far = losses[packet & mask]
    for number in range(len(program.windows)):
        window = program.windows[number]
        if so_far - losses[(packet + 1 - window.packets) & mask] >= window.losses:
            return True
    begins_burst = flow.consecutive_losses == 0
    return begins_burst and so_far != losses[(packet - program.recovery) & mask]


def hold_back_until(
    program: LinkProgram,
    flow: FlowState,
    recent_ns: Sequence[int],
    losses: Sequence[int],
    packet: int,
    desired_ns: int,
) -> int:
    """Return the earliest time, not before ``desired_ns``, at which ``packet`` may leave.

    ``recent_ns`` is a ring of the previous packets' release times, of mansd + 1 at least; −1 for
    packets that are not effectively delivered. The others ascend. Without a maximum of consecutive
    losses, only the first packet can be needed.
    """
    release_ns = max(desired_ns, flow.first_release_ns)
    mask, oldest = len(recent_ns) - 1, max(packet - program.mansd - 1, 0)
    delivered = _newest(recent_ns, oldest, packet)
    while delivered >= oldest and recent_ns[delivered & mask] > release_ns:
        delivered = _newest(recent_ns, oldest, delivered)
    first = delivered + 1
    if delivered < oldest:
        delivered = -1
    needed = 0
    for number in range(first, packet):
        time_ns = recent_ns[number & mask]
        if time_ns > release_ns:
            if needed == 0:
                needed = needed_after(program, losses, delivered, packet)
            if needed == 0:
                break
            needed -= 1
            release_ns = time_ns
        if time_ns >= 0:
            delivered = number
    return release_ns


def _newest(recent_ns: Sequence[int], oldest: int, end: int) -> int:
    """Return the newest effectively delivered packet below ``end``; below ``oldest``: none."""
    number, mask = end - 1, len(recent_ns) - 1
    while number >= oldest and recent_ns[number & mask] < 0:
        number -= 1
    return number


def needed_after(program: LinkProgram, losses: Sequence[int], delivered: int, packet: int) -> int:
    """Return 0 if all packets between ``delivered`` and ``packet`` may be lost; −1: all before it.

    Else at least so many of the effectively delivered ones between them must remain so: each takes
    one loss from every window.
    """
    burst = packet - 1 - delivered
    needed = 1 if burst > program.mansd else 0
    if not counts_losses(program):
        return needed
    mask = len(losses) - 1
    before = losses[(delivered + 1) & mask]
    for number in range(len(program.windows)):
        window = program.windows[number]
        beyond = before + burst - losses[(packet - window.packets) & mask] - window.losses
        needed = max(needed, beyond)
    if needed == 0 and before != losses[(delivered + 1 - program.recovery) & mask]:
        needed = 1
    return needed


def make_stale(
    program: LinkProgram,
    recent_ns: MutableSequence[int],
    losses: MutableSequence[int],
    packet: int,
    release_ns: int,
) -> int:
    """Mark the earlier packets that leave after ``release_ns`` as stale; return how many."""
    times, mask = len(recent_ns) - 1, len(losses) - 1
    oldest, stale, first = max(packet - program.mansd - 1, 0), 0, packet
    number = _newest(recent_ns, oldest, packet)
    while number >= oldest and recent_ns[number & times] > release_ns:
        recent_ns[number & times] = NEVER_NS
        stale, first = stale + 1, number
        number = _newest(recent_ns, oldest, number)
    if counts_losses(program):
        for number in range(first, packet):
            losses[(number + 1) & mask] = losses[number & mask] + 1
    return stale


def note_outcome(
    program: LinkProgram, losses: MutableSequence[int], packet: int, lost: bool
) -> None:
    """Store S behind a packet for which the decision has been made."""
    if counts_losses(program):
        mask = len(losses) - 1
        losses[(packet + 1) & mask] = losses[packet & mask] + (1 if lost else 0)
