"""Bit-exact replay of a recorded run.

Every machine receives its recorded inputs, in the order of the ``input`` column over all its tables
and at their recorded ``now_ns``. The replay compares

* every emitted row with the recorded row, byte for byte (``machine_replay.py``), and
* every emitted message with the message that the next process recorded as received
  (``run_replay.py``).

No output depends on the exact value of ``now_ns``. So it is only checked that ``now_ns`` is not
before the deadlines and does not decrease.
"""

from cosim.analysis.replay.replay_result import ReplayResult
from cosim.analysis.replay.run_replay import replay, replay_run

__all__ = ["ReplayResult", "replay", "replay_run"]
