"""Maximum error first, or try-once-discard; see native/impairments/maximum_error.c.

Walsh, Ye and Bushnell (Stability analysis of networked control systems, IEEE Trans. Control Systems
Technology 10(3), 2002) give the network to the node with the largest weighted error.
"""

from typing import ClassVar, Literal

from netem.impairments.clauses import Clause
from netem.impairments.feature import Scheduler


class MaximumError(Scheduler):
    """Sends first the flow with the largest error, relative to its threshold, that waits.

    The sensors write it into the headers of their updates (docs/wire.md). It is no number of a flow.
    """

    kind: Literal["maximum_error"] = "maximum_error"

    clauses: ClassVar = (
        Clause("maximum_error", "rate 1mbit queue 20 maximum_error", implied={"kind": "maximum_error"}),
    )
    tc_missing: ClassVar = "the discipline maximum_error"
    numbers: ClassVar = (0,)

    def meaning(self) -> str:
        return "more are dropped; it sends first what is of the flow with the largest error"
