"""Bit-exact replay of a recorded run.

Every machine receives its recorded inputs, in the order of the ``input`` column over all its tables
and at their recorded ``now_ns``. The replay compares

* every emitted row with the recorded row, byte for byte (``machine_replay.py``), and
* every emitted message with the message that the next process recorded as received
  (``message_comparison.py``).

No output depends on the exact value of ``now_ns``. So it is only checked that ``now_ns`` is not
before the deadlines and does not decrease.
"""

import gc
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from cosim.analysis.replay.machine_replay import MachineReplay
from cosim.analysis.replay.message_comparison import MessageComparison
from cosim.analysis.replay.replay_result import Replay
from cosim.record.run_record import RunRecord
from noack.protocol.topology import LOOP_ROLES

__all__ = ["Replay", "replay"]


def replay(record: RunRecord) -> Replay:
    """Replay a run and compare it with its record; a process is replayed up to its first gap.

    The record is read part by part, so that memory does not grow with the length of the run.
    """
    # A diverging run overflows and is replayed all the same.
    with np.errstate(all="ignore"), _without_collection():
        machines = {role: MachineReplay(role, record) for role in LOOP_ROLES}
        messages = MessageComparison(record, machines)
        for part in record.slices():
            for machine in machines.values():
                machine.take(part)
            messages.take(part)
    results = tuple(result for one in machines.values() for result in one.results)
    return Replay(processes=results, messages=messages.results())


@contextmanager
def _without_collection() -> Iterator[None]:
    """Suspend the collection of cycles: a part has many objects, but no cycles."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()
