"""The words of claims that ended, were not checked or do not apply to a run."""

from collections.abc import Mapping, Sequence

from cosim.analysis.summary.summary_model import Claim, ClaimCause, ConformancePart
from cosim.output.conformance_words import failure_text

_TEXTS: Mapping[ClaimCause, str] = {
    ClaimCause.CONFORMANCE: "the run is not one of the loop document from then on",
    ClaimCause.NO_DOCUMENT: "no run can be compared with this bound: {}",
    ClaimCause.NO_CERTIFICATE: "no certificate: {}",
    ClaimCause.CHANGED: "settings changed at {} s, before anything could be compared",
    ClaimCause.OUTSIDE: "{}",
    ClaimCause.MISSING_ROWS: "rows of {} are missing from the record",
    ClaimCause.MISSING_MEASUREMENT: "a measurement is missing",
    ClaimCause.NO_ERROR: "the controller's error is not on record, or not finite",
    ClaimCause.CLOCK: "{} received a message before it was sent, beyond the errors of the clocks",
    ClaimCause.SETPOINTS: "sensor and controller took the change of the set-point at different times",
    ClaimCause.ROUNDING: "the threshold is below the rounding error of x at the set-point",
    ClaimCause.LOSSES: "losses beyond the guarantee ({})",
    ClaimCause.WATCHDOG: "the watchdog replaced the input",
    ClaimCause.SAFE_INPUT: "the controller had no state and sent its safe input",
    ClaimCause.ACKNOWLEDGED: 'network.protocol = "ack": x_s is reset when an update is acknowledged, '
    "and not at every event as (I1), and every claim that follows from it, assumes",
    ClaimCause.IDEAL_LOOP: "assumes a continuous trigger, and a network and input without delay, which no "
    "sampled loop has",
}
"""By the cause; ``{}`` stands for its detail."""


def claim_reason(claim: Claim, conformance: Sequence[ConformancePart]) -> str:
    """Return why a claim ended, was not checked or does not apply; empty if it held or was violated.

    Args:
        claim: of a loop.
        conformance: that of the loop.
    """
    if claim.cause is None:
        return ""
    if claim.cause is ClaimCause.CONFORMANCE:
        for part in conformance:
            if part.certificate == claim.source and part.failure is not None:
                return failure_text(part.failure)
    return _TEXTS[claim.cause].format(claim.detail)
