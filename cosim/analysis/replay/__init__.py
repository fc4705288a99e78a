"""Bit-exact replay of a recorded run.

Every machine receives its recorded inputs, in the order of the ``input`` column over all its tables
and at their recorded ``now_ns``. The replay compares

* every emitted row with the recorded row, byte for byte (``input_replay.py``), and
* every emitted message with the message that the next process recorded as received
  (``message_comparison.py``).

No output depends on the exact value of ``now_ns``. So it is only checked that ``now_ns`` is not
before the deadlines and does not decrease.
"""

import numpy as np

from cosim.analysis.replay.machine_replay import MachineReplay
from cosim.analysis.replay.message_comparison import MessageComparison
from cosim.analysis.replay.replay_result import Replay
from cosim.record.run_record import RunRecord
from noack.protocol.topology import LOOP_ROLES

__all__ = ["Replay", "replay"]


def replay(record: RunRecord) -> Replay:
    """Replay a run and compare it with its record; a process is replayed up to its first gap.

    In a run of several loops, the network is replayed once, for all of them: ``record`` is that of
    the network, or that of a loop, whose network is not replayed. The record is read part by part,
    so that memory does not grow with the length of the run.
    """
    roles = ("netem",) if record.is_network else LOOP_ROLES
    machines = {
        role: MachineReplay(role, record)
        for role in roles
        if record.number is None or role != "netem"
    }
    messages = None if record.is_network else MessageComparison(record, machines)
    with np.errstate(all="ignore"):  # a diverging run overflows and is replayed all the same
        for part in record.slices():
            for machine in machines.values():
                machine.take(part)
            if messages is not None:
                messages.take(part)
    results = tuple(result for one in machines.values() for result in one.results)
    return Replay(processes=results, messages=() if messages is None else messages.results())
