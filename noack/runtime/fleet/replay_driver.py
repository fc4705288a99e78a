"""The loop that replays the recorded inputs of a fleet and compares its rows."""

from collections.abc import Callable
from typing import Any

from noack.config.fleet_layout import HEADER_WORDS, NEEDS_MATRIX, SENDS
from noack.runtime.fleet.driver_layout import DriverMemory
from noack.runtime.native import libc_calls as libc

DONE = 0
DIFFERS = 1
MATRIX_MISSING = 2
EARLY = 3

Machine = Callable[..., Any]


def replay_driver_of(handle: Machine, on_timer: Machine) -> Machine:
    """Return the replay of a role with these two functions."""

    def replay(
        memory: DriverMemory, own: Any, record: Any, order: Any, vector: Any, words: Any,
        sent: Any, end: int,
    ) -> Any:  # fmt: skip
        """Replay up to input ``end``; return why it stopped at input ``order[0]``.

        Args:
            memory: that of the driver, without sockets.
            own: the arrays of the role.
            record: (bytes,) the rows of both tables.
            order: (1 + inputs,) the next input; then of each input twice the place of its row in
                ``record``, plus 1 for a timer.
            vector: (2,) of a message's row, the place of the vector in words, and its entries.
            words: (k,) scratch; the row that differs.
            sent: (1 + inputs * k,) number of messages sent; number, time and vector of each.
            end: number of inputs.
        """
        driver, fleet = memory.driver[0], memory.fleet
        while order[0] < end:
            entry = order[1 + order[0]]
            is_timer = (entry & 1) != 0
            row_bytes = driver.timer_row_bytes if is_timer else driver.message_row_bytes
            begin = libc.address_of(record) + (entry >> 1)
            loop = 0
            if driver.prefix_bytes != 0:
                libc.memcpy(libc.address_of(memory.data), begin, driver.prefix_bytes)
                loop = int(memory.data[0])
            content_bytes = row_bytes - driver.prefix_bytes
            libc.memcpy(libc.address_of(words), begin + driver.prefix_bytes, content_bytes)
            if is_timer:
                if words[3] < fleet.loops[loop].due_ns:
                    return EARLY
                outputs = on_timer(fleet, own, loop, words[3])
            else:
                fleet.arrived[2], fleet.arrived[3] = words[1], words[2]
                for k in range(vector[1]):
                    fleet.arrived[HEADER_WORDS + k] = words[vector[0] + k]
                outputs = handle(fleet, own, loop, 0, words[3])
            if outputs == NEEDS_MATRIX:
                return MATRIX_MISSING
            if outputs == SENDS:
                count = 2 + memory.wire.settings[0].entries_sent
                for k in range(count):
                    sent[1 + sent[0] * count + k] = fleet.out[2 + k]
                sent[0] += 1
            fleet.fleet[0].out = fleet.fleet[0].notes = 0
            for k in range(content_bytes // 8):
                if fleet.row[k] != words[k]:
                    return DIFFERS
            order[0] += 1
        return DONE

    return replay
