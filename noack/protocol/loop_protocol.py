"""What depends on whether updates are acknowledged: the paper's loop, and the baseline.

Every process and every reader of a record asks the scenario's protocol for a property of the loop.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class LoopProtocol:
    """A protocol of the loop."""

    acknowledges: bool
    """Whether updates are acknowledged, and x_s is reset by acknowledgements only.

    Then the paper's theorems do not apply, and settings cannot change during a run.
    """
    states_caption: str
    """When x_s and x_c jump, for readers; ``{known}`` is the state that they jump to."""
    error_caption: str  # when the sensor's error is reset, for readers
    summary: str  # one sentence for readers
    reset: str  # when x_s is reset, for readers


PROTOCOLS: Mapping[str, LoopProtocol] = {
    "none": LoopProtocol(
        acknowledges=False,
        states_caption="At every event x_s jumps to {known}; x_c does so only when the update "
        "arrives. ",
        error_caption="The sensor's error ‖e_s‖ = ‖x_s − x‖ is reset when it exceeds the "
        "threshold. The controller's error ‖e_c‖ = ‖x_c − x‖ may exceed the threshold while "
        "packets are lost; no process of the loop can measure it.",
        summary="Nothing is acknowledged.",
        reset="at every event",
    ),
    "ack": LoopProtocol(
        acknowledges=True,
        states_caption="x_c jumps to {known} when an update arrives, x_s when its acknowledgement "
        "arrives. ",
        error_caption="The sensor's error ‖e_s‖ = ‖x_s − x‖ is reset by acknowledgements; without "
        "one, the sensor transmits repeatedly. The controller's error is ‖e_c‖ = ‖x_c − x‖.",
        summary="**Updates are acknowledged.**",
        reset="when an update is acknowledged",
    ),
}
