"""The adversary that needs no thought: everything is lost that may be lost."""


class WorstCaseLoss:
    """Every datagram would be lost; only the MANSD cap lets one through, every M-th."""

    def lost(self) -> bool:
        """Whether the next datagram would be lost: always."""
        return True
