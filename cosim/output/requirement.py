"""What ``--require`` may ask of a scenario or a run, beside a command that succeeds."""

from enum import StrEnum


class Requirement(StrEnum):
    """What is required; else the exit status is 1."""

    CERTIFICATE = "certificate"
    """Of a scenario: its plant has a certificate for its schedule. Of a run: one covers all of it."""
    GUARANTEE = "guarantee"
    """Of a scenario: the network enforces the guarantee, too. Of a run: the guarantee was kept."""
    STABLE = "stable"
    """Of a scenario: ‖x‖ is proven to have a bound. Of a run: it is stable, as its verdict says."""
