"""The guarantee: at most M − 1 successive drops per flow, whatever the loss model says.

MANSD is the maximum allowable number of successive dropouts (Garcia & Antsaklis, Section III).
"""

from noack.records import Fate


class MansdCap:
    """Counts one flow's successive drops and overrules a drop that would exceed the maximum.

    Args:
        mansd: M − 1, or None for no cap.
        first_delivered: the counter starts full, so that the flow's first datagram passes, cap or
            not: the paper's delivered t_0.
    """

    def __init__(self, mansd: int | None, *, first_delivered: bool = True) -> None:
        self._mansd = mansd
        self._full = first_delivered
        self.run = 0
        """Successive drops up to and including the last datagram."""

    def decide(self, lost: bool) -> Fate:
        """Return the fate of the next datagram, given the loss model's word."""
        full = self._full or (self._mansd is not None and self.run >= self._mansd)
        if lost and not full:
            self.run += 1
            return Fate.DROPPED
        self.run = 0
        self._full = False
        return Fate.FORCED if lost else Fate.DELIVERED
