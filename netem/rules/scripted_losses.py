"""Losses that are written down: periodic ones, scripts and traces, by the datagram's number."""

from collections.abc import Sequence

from netem.rule_records import ScriptSettings


def lost(script: ScriptSettings, numbers: Sequence[int], packet: int) -> bool:
    """Whether datagram ``packet`` of a flow would be lost.

    Args:
        script: the script.
        numbers: the program's table of integers; the script's ascend.
        packet: number of the datagram in its flow.
    """
    if script.burst >= 0:
        return packet >= script.first and (packet - script.first) % script.period < script.burst
    wanted = packet % script.period if script.period > 0 else packet
    low, high = script.begin, script.end
    while low < high:
        middle = (low + high) // 2
        if numbers[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low < script.end and numbers[low] == wanted
