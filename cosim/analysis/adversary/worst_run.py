"""The worst run that the adversary found, as values."""

import math
from dataclasses import asdict, dataclass

from cosim.analysis.adversary.loop_flows import Objective, Pattern
from netem.guarantee.loss_guarantee import outcome_letters

BREACH = 1 + 1e-9
"""Share of the bound from which on a run refutes it; below are rounding errors."""


@dataclass(frozen=True)
class WorstRun:
    """The worst run found, for one objective.

    The values are sup ‖W e_c‖ and sup ‖x‖, both scaled by the shape of their bounds, ∫‖x‖² dt, and
    seconds between two events.
    """

    objective: Objective
    horizon_s: float
    value: float | None
    """Infinite if the loop diverges; None if there is no inter-event time above 0."""
    at_s: float | None
    """Time of the supremum, or of the later of the two closest events."""
    pattern: Pattern
    """Whether the update of each event is delivered."""
    event_s: tuple[float, ...]
    """Times of the events."""
    exact: bool
    """Whether every admissible pattern was covered, or this one diverges; else others may be worse."""
    nodes: int
    """Segments between events that were computed."""
    runs: int
    """Runs up to the horizon; if every pattern was covered, those of this search alone."""
    lossless: float | None
    """The value without losses."""
    with_own_network: float | None
    """The value with the losses of the scenario's own network."""
    certified: float | None
    """The certificate's bound; None without a certificate."""

    @property
    def tightness(self) -> float | None:
        """Found / certified value, or certified / found for inter-event times: at most 1."""
        if not self.value or not self.certified:
            return None
        if self.objective is Objective.INTER_EVENT:
            return self.certified / self.value
        return self.value / self.certified

    @property
    def breaches(self) -> bool:
        """Whether this run refutes the certificate."""
        return self.tightness is not None and self.tightness > BREACH

    @property
    def diverges(self) -> bool:
        """Whether the loop diverges under the pattern."""
        return self.value == math.inf

    @property
    def text(self) -> str:
        """The pattern, one letter per event: ``D`` delivered, ``L`` lost."""
        return outcome_letters(self.pattern)

    def to_json(self) -> dict[str, object]:
        """Return all fields for JSON; an infinite value becomes null."""
        document = asdict(self) | {
            "objective": self.objective.value,
            "pattern": self.text,
            "delivered": [event for event, delivered in enumerate(self.pattern) if delivered],
            "tightness": self.tightness,
            "breaches": self.breaches,
            "diverges": self.diverges,
        }
        return {key: None if value == math.inf else value for key, value in document.items()}


def reported_value(value: float, objective: Objective) -> float | None:
    """Return an objective's value as it is reported: an inter-event time has its sign reversed."""
    if objective is not Objective.INTER_EVENT:
        return value
    return None if value == -math.inf else -value
