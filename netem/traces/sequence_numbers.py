"""Which packets arrived, by numbers that wrap around, for a sender with a constant period.

One of R numbers says which packet it is up to multiples of R (2ᵇ for b bits). How many times they wrapped
around during a gap follows from the time: with a period p, the level t/p − u (arrival time t, packet u) is
constant up to delays, so its lower envelope rises by R for each wrap that was missed. If it changes by
something else, and the numbers do not go on, the sender was restarted.

A gap of Δt holds at most the packets that the sender can send in Δt, Δt/p. A sender that pauses, as an
event-triggered one does, has longer gaps between its packets; the level then rises at each pause. From its
numbers nobody can tell a pause that is longer than R periods from the loss of R packets.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d

from netem.traces.smallest_delays import Int64s, envelope_slope

Reals = NDArray[np.float64]
_WINDOW = 16
"""Arrivals over which a rough period is taken, so that packets that arrive in groups do not mislead."""
_NEIGHBOURS = 256
"""Arrivals before and after a jump whose lower envelopes are compared."""
_MOST_REORDERED, _LOOKED_AT = 4096, 64
"""Arrivals before and after a jump, and numbers of them, by which a restart is told from another order."""
_SPREAD_WINDOW = 64
_FEWEST_AFTER_RESTART = 8
"""A restart to smaller numbers is told from late packets by this many arrivals."""
_CLEAR = 8
"""A jump forward by no more packets is a loss, whatever the time says."""
_DELAY_CHANGE_NS = 10**9
"""A change of the smallest delay by no more is not taken for a restart."""
_DELAY_CHANGE_SHARE = 0.05
"""Nor is one by this share of the gap."""
_MOST_OF_CYCLE = 1 / 8
"""A change of the level is a number of wraps up to this share of R."""
_CERTAIN_SHARE = 1 / 64
"""A change of the level by this share of R is no restart."""
_COINCIDENCE = 0.01
"""Chance above which a restart that looks like wraps is no rare coincidence."""
_MOST_RESTARTS = 1 / 20
"""More restarts per arrival are no restarts: the numbers are none."""
_FAR_AHEAD_NS, _FAR_BEHIND_NS = 5 * 10**9, 60 * 10**9
"""A single number that is ahead or behind by more than this does not belong to the sequence."""
_FEWEST_PAUSES = 3
"""A sender with so many pauses is one that pauses."""
_MOST_OFF = 1 / 8
"""Share of R by which delays may vary at a gap that holds R packets."""
_CERTAIN_RESTART = 2**50
"""A jump by so many packets is a restart."""
_STEADY = 0.95
"""Correlation of numbers and times below which the numbers jump at random."""
_FAR_BACK = 32
_WIDE_SHARE = 0.01
"""Share of the arrivals that may jump back by more than a quarter of R."""
_FAR_BACK_SHARE, _FEWEST_FAR_BACK = 0.1, 8
"""Two counters in one flow jump back by more than 32 packets at more than this share of the arrivals."""


class Arrivals(NamedTuple):
    """The packets of the k arrivals that belong to the sequence, in their order."""

    arrival: Int64s  # (k,) Its place among all arrivals
    packet: Int64s  # (k,) Number without wrap-around, from any origin in each part
    part: Int64s  # (k,) 0, and one more after each restart of the sender
    period_ns: float
    uncertain: tuple["UncertainGap", ...] = ()
    pauses: int = 0  # Gaps in which the sender sent nothing, as far as they are counted


class UncertainGap(NamedTuple):
    """A gap in which it is not certain how often the numbers wrapped around."""

    place: int  # Of the k arrivals, the first one after it
    wraps: int  # The number that is assumed
    most: int  # The largest number for which there was time


def find_packets(number: NDArray[np.uint64], t_ns: Int64s, bits: int, size: int | None = None) -> Arrivals:
    """Return which packets arrived.

    Args:
        number: Numbers from 0 on, in the order of arrival.
        t_ns: Times of arrival, ascending.
        bits: Size of the numbers.
        size: How many numbers there are; by default all of these bits.

    Raises:
        ValueError: what is wrong with the numbers.
    """
    size = size or 1 << bits
    steps = nearest_steps(number, size)
    if not (steps > 0).any():
        raise ValueError("do not ascend")
    index = np.arange(len(number))
    is_soon = np.diff(t_ns) < _FAR_BACK * int(t_ns[-1] - t_ns[0]) / len(steps)
    far_back = np.count_nonzero((steps < -_FAR_BACK) & is_soon)
    if far_back > max(_FAR_BACK_SHARE * len(steps), _FEWEST_FAR_BACK):
        if _continues(number, size):
            raise ValueError("belong to two counters")
        is_wide = (steps < -max(size / 4, _FAR_BACK)) & is_soon
        if np.count_nonzero(is_wide) > max(_WIDE_SHARE * len(steps), _FEWEST_FAR_BACK):
            raise ValueError(f"jump at random, or packets overtake more others than {bits} bits can tell")
        period_ns = _period_of_all(steps, t_ns)
    else:
        period_ns = _rough_period(steps, t_ns, size)
    strays = _strays(steps, period_ns) | _strays_at_ends(steps, t_ns, period_ns)
    if strays.any():
        index, t_ns = index[~strays], t_ns[~strays]
        steps = nearest_steps(number[~strays], size)
    arrivals = _with_wraps(index, steps, t_ns, period_ns, 0.01, size)
    refined_ns, error = _refined_period(arrivals, t_ns)
    if refined_ns:
        arrivals = _with_wraps(index, steps, t_ns, refined_ns, error, size)
    if arrivals.pauses >= _FEWEST_PAUSES:
        arrivals = _with_pauses(index, steps, t_ns, period_ns, size)
    if arrivals.part[-1] > 1 + _MOST_RESTARTS * len(number):
        raise ValueError("jump at random")
    return arrivals


def _strays(steps: Int64s, period_ns: float) -> NDArray[np.bool_]:
    """Return which numbers are far from those before and after, which are near to each other."""
    strays = np.zeros(len(steps) + 1, bool)
    there, back = steps[:-1].astype(float), steps[1:].astype(float)
    far = (there > _FAR_AHEAD_NS / period_ns) | (there < -_FAR_BEHIND_NS / period_ns)
    strays[1:-1] = far & (np.abs(there) > _FAR_BACK) & (np.abs(there + back) < np.abs(there) / 8)
    packet = np.concatenate(([0], np.cumsum(steps)))
    for i in np.flatnonzero(strays).tolist():
        # A number between those of its neighbours is one of a packet that was overtaken.
        here = slice(max(i - _NEIGHBOURS, 0), i + _NEIGHBOURS)
        others = packet[here][~strays[here]]
        strays[i] = not others.min() <= packet[i] <= others.max()
    return strays


def _strays_at_ends(steps: Int64s, t_ns: Int64s, period_ns: float) -> NDArray[np.bool_]:
    """Return which of the first and last numbers are far from all others: those of another session.

    Of more of them, a restart of the sender is noticed.
    """
    strays = np.zeros(len(steps) + 1, bool)
    ahead = steps.astype(float) - np.diff(t_ns) / period_ns
    far = (np.maximum(ahead, -steps) > _FAR_AHEAD_NS / period_ns) & (np.abs(steps) > _FAR_BACK)
    jumps = np.flatnonzero(far)
    before = jumps[jumps < _FEWEST_AFTER_RESTART - 1]
    behind = jumps[jumps > len(steps) - _FEWEST_AFTER_RESTART]
    if len(before) == 1 and len(steps) > 2 * _FEWEST_AFTER_RESTART:
        strays[: before[0] + 1] = True
    if len(behind) == 1 and len(steps) > 2 * _FEWEST_AFTER_RESTART:
        strays[behind[0] + 1 :] = True
    return strays


def nearest_steps(number: NDArray[np.uint64], size: int) -> Int64s:
    """Return the steps from each number to the next of ``size`` numbers, from −R/2 to R/2."""
    steps = np.diff(number).view(np.int64)
    if size == 1 << 64:
        return steps
    if size == 1 << 63:
        return np.asarray(((steps + (1 << 62)) & np.int64((1 << 63) - 1)) - (1 << 62))
    return np.asarray((steps + size // 2) % size - size // 2)


def _continues(number: NDArray[np.uint64], size: int) -> bool:
    """Whether most numbers continue one of the four before, as those of two counters do."""
    known = np.zeros(len(number), bool)
    for distance in range(1, 5):
        for offset in range(distance):  # each distance-th number
            ahead = nearest_steps(number[offset::distance], size)
            known[offset::distance][1:] |= (ahead >= 0) & (ahead <= 4)
    return float(known.mean()) > 0.3


def _rough_period(steps: Int64s, t_ns: Int64s, size: int) -> float:
    """Return the median of Δt/Δn over small steps."""
    small = np.abs(steps.astype(float)) <= max(size / 8, 1)
    elapsed_ns = np.diff(t_ns)
    for window in (_WINDOW, 1):
        if len(steps) < window:
            continue
        whole = _sums(small.astype(np.int64), window) == window
        advance, time_ns = _sums(steps, window), _sums(elapsed_ns, window)
        useful = whole & (advance > 0)
        if useful.sum() >= (_WINDOW if window > 1 else 1):
            period_ns = float(np.median(time_ns[useful] / advance[useful]))
            if period_ns > 0:
                return period_ns
    advance_in_all = int(steps[small].sum())
    if advance_in_all > 0 and elapsed_ns[small].any():
        return float(elapsed_ns[small].sum()) / advance_in_all
    raise ValueError("do not show the sender's period")


def _sums(values: Int64s, window: int) -> Int64s:
    """Return the sums of so many successive values."""
    total = np.concatenate(([0], np.cumsum(values)))
    return np.asarray(total[window:] - total[:-window])


def _period_of_all(steps: Int64s, t_ns: Int64s) -> float:
    """Return the period if delays of many periods are usual, and the order of arrival shows little."""
    packet = np.concatenate(([0.0], np.cumsum(steps.astype(float))))
    if np.corrcoef(packet, t_ns - t_ns[0])[0, 1] < _STEADY:
        raise ValueError("jump at random")
    return float(np.polyfit(packet, (t_ns - t_ns[0]).astype(float), 1)[0])


def _refined_period(arrivals: Arrivals, t_ns: Int64s) -> tuple[float, float]:
    """Return the period in the longest stretch without a gap, and its relative error; 0: too short."""
    time_ns, advance = np.diff(t_ns), np.diff(arrivals.packet)
    is_edge = (np.diff(arrivals.part) != 0) | (time_ns > 100 * arrivals.period_ns) | (np.abs(advance) > 100)
    edges = np.concatenate(([0], np.flatnonzero(is_edge) + 1, [len(t_ns)]))
    longest = int(np.argmax(np.diff(edges)))
    here = slice(int(edges[longest]), int(edges[longest + 1]))
    packet, at_ns = arrivals.packet[here], t_ns[here]
    if len(packet) < 4 * _WINDOW:
        return 0.0, 0.0
    order = np.argsort(packet, kind="stable")
    packet, at_ns = packet[order] - packet.min(), at_ns[order] - at_ns.min()
    period_ns = envelope_slope(packet, at_ns)
    if not 0.5 < period_ns / arrivals.period_ns < 2:
        return 0.0, 0.0
    spread = _spread(np.diff(at_ns) / period_ns - np.diff(packet), at_ns / period_ns - packet)
    return period_ns, (1 + spread) / float(packet[-1])


def _spread(excess: Reals, level: Reals) -> float:
    """Return by how much the level usually varies within 64 arrivals."""
    windows = len(level) // _SPREAD_WINDOW
    if windows < 4:
        return 4 * float(np.median(np.abs(excess)))
    by_window = level[: windows * _SPREAD_WINDOW].reshape(windows, -1)
    return float(np.median(np.ptp(by_window, axis=1)))


def _noise(level: Reals) -> float:
    """Return by how much the smallest level usually differs between neighbours."""
    starts = np.arange(0, len(level), _NEIGHBOURS)
    lowest = np.minimum.reduceat(level, starts)
    return float(np.median(np.abs(np.diff(lowest)))) if len(lowest) > 4 else 0.0


def _with_wraps(
    index: Int64s, steps: Int64s, t_ns: Int64s, period_ns: float, error: float, size: int
) -> Arrivals:
    """Return the packets for a period that is known up to a relative error."""
    cycle = float(size)
    restarts = np.abs(steps.astype(float)) > _CERTAIN_RESTART
    pauses = np.diff(t_ns) / period_ns
    steps = np.where(restarts, np.rint(pauses).astype(np.int64), steps)
    packet = np.concatenate(([0], np.cumsum(steps)))
    level = (t_ns - t_ns[0]) / period_ns - packet
    excess = pauses - steps
    spread, noise = _spread(excess, level), _noise(level)
    added = np.zeros(len(packet), np.int64)
    part = np.append(0, restarts.astype(np.int64))
    uncertain: list[UncertainGap] = []
    begin = sender_pauses = 0
    for i in _jumps(excess, steps, level, cycle, spread):
        step, pause = int(steps[i - 1]), float(pauses[i - 1])
        # Packets that have waited during a pause arrive together after it: only behind them does the
        # level show the network's usual delay.
        before = float(level[max(begin, i - _NEIGHBOURS) : i].min())
        waiting = min(max(pause, float(level[i]) - before, 0.0), len(level))
        following = level[i : i + _NEIGHBOURS + int(waiting)]
        rise = float(following.min()) - before
        most = _most_wraps(pause * (1 + error), step, cycle)
        wraps = min(round(rise / cycle), most)
        allowed = max(_DELAY_CHANGE_NS / period_ns, _DELAY_CHANGE_SHARE * pause, 6 * spread)
        # Small numbers come round so soon that a restart is told from wraps by little.
        certain = max(_CERTAIN_SHARE * cycle, 4 * noise + error * pause)
        allowed = min(allowed, certain, _MOST_OF_CYCLE * cycle)
        if wraps > 0 and abs(rise - wraps * cycle) <= allowed:
            added[i] = wraps * size
            if pause * error > cycle / 4 or 2 * allowed > _COINCIDENCE * cycle:
                uncertain.append(UncertainGap(i, wraps, most))
        elif step < 0:
            lasts = (t_ns[i + len(following) - 1] - t_ns[i]) / period_ns
            enough = len(following) >= _FEWEST_AFTER_RESTART and lasts > spread + _FEWEST_AFTER_RESTART / 2
            if rise <= max(2.0, 1.5 * spread) or not enough or _is_reordered(packet, begin, i):
                continue
            part[i] = 1
        elif step > _CLEAR and abs(rise) > allowed:
            # While a queue empties, the level falls to where it was before; only a restart is below.
            lowest = float(level[begin:i].min()) - allowed - error * (i - begin)
            if (rise < 0 and following.min() > lowest) or _is_reordered(packet, begin, i):
                continue
            part[i] = 1
        else:
            sender_pauses += step > 0 and min(rise, pause - step) > max(allowed, _CLEAR)
            continue
        begin = i
    packet = packet + np.cumsum(added)
    return Arrivals(index, packet, np.cumsum(part), period_ns, tuple(uncertain), sender_pauses)


def _most_wraps(pause: float, step: int, cycle: float) -> int:
    """Return how often the numbers can wrap around in a gap of so many periods, with a step behind it."""
    return max(math.floor((pause - step) / cycle + _MOST_OFF), 0)


def _with_pauses(index: Int64s, steps: Int64s, t_ns: Int64s, period_ns: float, size: int) -> Arrivals:
    """Return the packets of a sender that pauses, so that a gap is a pause as long as it can be one.

    A restart is a step that does not fit into its gap.
    """
    pauses = np.diff(t_ns) / period_ns
    packet = np.concatenate(([0], np.cumsum(steps)))
    part = np.zeros(len(packet), np.int64)
    uncertain = []
    begin = 0
    for i in (np.flatnonzero((steps < 0) | (steps > _CLEAR) | (pauses > size / 2)) + 1).tolist():
        step, pause = int(steps[i - 1]), float(pauses[i - 1])
        most = _most_wraps(pause, step, float(size))
        fits = 0 < step <= pause + _CLEAR
        if fits and most:
            uncertain.append(UncertainGap(i, 0, most))
        enough = len(packet) - i >= _FEWEST_AFTER_RESTART
        if not fits and step and enough and abs(step) > _CLEAR and not _is_reordered(packet, begin, i):
            part[i], begin = 1, i
    return Arrivals(index, packet, np.cumsum(part), period_ns, tuple(uncertain), _FEWEST_PAUSES)


def _is_reordered(packet: Int64s, begin: int, i: int) -> bool:
    """Return whether the numbers at a jump are those of one sequence in another order.

    Args:
        packet: numbers without wraps.
        begin: the first arrival of this part.
        i: the first arrival after the jump.
    """
    before = packet[max(begin, i - _MOST_REORDERED) : i]
    after = packet[i : i + _MOST_REORDERED]
    next_ones = after[1 : 1 + _FEWEST_AFTER_RESTART]
    if len(next_ones) and abs(np.median(next_ones) - packet[i]) >= abs(packet[i] - packet[i - 1]):
        return True  # not this one begins something else, but perhaps the next
    if packet[i] > packet[i - 1]:
        # The numbers that were skipped arrive, too.
        skipped = np.arange(max(packet[i - 1] + 1, packet[i] - _LOOKED_AT), packet[i])
        arrive = np.isin(skipped, after) | np.isin(skipped, before)
        return 2 * int(arrive.sum()) > len(skipped)
    # The numbers behind are missing ones; a sender that restarts repeats some, or goes below all.
    behind = after[:_LOOKED_AT]
    behind = behind[behind < before.max()]
    missing = (behind > before.min()) & ~np.isin(behind, before)
    return 2 * int(missing.sum()) > len(behind)


def _jumps(excess: Reals, steps: Int64s, level: Reals, cycle: float, spread: float) -> list[int]:
    """Return the arrivals at which the level jumps, and may stay where it is then."""
    after = minimum_filter1d(level, _NEIGHBOURS, origin=-(_NEIGHBOURS // 2), mode="nearest")
    before = minimum_filter1d(level, _NEIGHBOURS, origin=_NEIGHBOURS // 2 - 1, mode="nearest")
    jumps = (np.abs(excess) > min(cycle / 4, _CLEAR)) | (steps < 0)
    stays = np.abs(after[1:] - before[:-1]) > max(1.0, spread / 2)
    return (np.flatnonzero(jumps & stays) + 1).tolist()
