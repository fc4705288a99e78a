"""Blackouts: nothing comes through during intervals of time."""

from collections.abc import Sequence

from netem.rule_records import BlackoutSettings


def dark(darkness: BlackoutSettings, times_ns: Sequence[int], now_ns: int) -> bool:
    """Whether it is dark at ``now_ns``.

    Args:
        darkness: the intervals' place in the table: begin, end, begin, end, …, ascending.
        times_ns: the program's table of integers.
        now_ns: now.
    """
    if darkness.period_ns > 0 and now_ns >= 0:
        now_ns %= darkness.period_ns
    for place in range(darkness.begin, darkness.end, 2):
        if now_ns < times_ns[place]:
            return False
        if now_ns < times_ns[place + 1]:
            return True
    return False
