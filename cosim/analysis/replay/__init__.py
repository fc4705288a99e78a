"""Bit-exact replay of a recorded run.

Every machine is fed its recorded inputs, in the order of the ``input`` column over all its tables
and at their recorded ``now_ns``. Compared are

* every row that it emits with the recorded row, byte for byte (``machine_replay.py``), and
* every message that it emits with what the next process recorded as received
  (``message_comparison.py``).

What no output depends on cannot be compared: ``now_ns`` is checked only against the deadlines and
against running backward.
"""

import numpy as np

from cosim.analysis.replay.machine_replay import replay_machine
from cosim.analysis.replay.message_comparison import check_messages
from cosim.analysis.replay.replay_result import Replay
from cosim.record.run_record import RunRecord
from noack.protocol.topology import LOOP_ROLES

__all__ = ["Replay", "replay"]


def replay(record: RunRecord) -> Replay:
    """Replay a run and compare it with its record; a process with gaps is replayed up to there."""
    with np.errstate(all="ignore"):  # a run that diverged is replayed, too
        replayed = {role: replay_machine(role, record) for role in LOOP_ROLES}
        messages = check_messages(record, replayed)
    accounts = tuple(account for one in replayed.values() for account in one.accounts)
    return Replay(accounts, messages)
