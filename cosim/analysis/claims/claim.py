"""A claim about a run, its verdict, and the curve that shows its bound."""

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]


class ClaimVerdict(StrEnum):
    """The result of checking a claim against a run."""

    HELD = "held"
    VIOLATED = "violated"
    VOID = "void"
    """An assumption of the claim was violated before the end of the run."""
    NOT_APPLICABLE = "not applicable"
    """The bound was exceeded, but no sampled loop meets the claim's assumptions: this run does not
    refute it."""


class Claim(NamedTuple):
    """One claim, checked against one run."""

    what: str
    source: str
    bound: str
    """The claim as a formula with its numbers."""
    certified: float | None
    """The claimed constant."""
    observed: float | None
    """The smallest constant with which the claim holds for this run."""
    ratio: float | None
    """Largest share of the bound that was reached; at most 1 if the claim held."""
    verdict: ClaimVerdict
    since_s: float | None
    """Time from which the claim was violated, void or not applicable."""
    why: str
    from_s: float = 0.0
    """The claim begins here: at the start of the run, or after a change of settings."""
    until_s: float | None = None
    """The claim ends here, at a change of settings; None: at the end of the run."""


class Envelope(NamedTuple):
    """A curve that bounds a measured one."""

    label: str
    quantity: Literal["e_c", "x", "inter_event"]
    """``"e_c"`` for ‖e_c‖_W, ``"x"`` for ‖x‖, ``"inter_event"`` for a lower bound in seconds."""
    t_s: Reals
    values: Reals
    kind: Literal["certified", "identity", "printed"] = "certified"
    """The source: a certificate, identity (I1), or a formula of the paper."""


def void_claim(
    what: str, source: str, since_s: float, why: str, until_s: float | None = None
) -> Claim:
    """A claim that cannot be checked because there is no bound."""
    verdict = ClaimVerdict.VOID
    return Claim(what, source, "none", None, None, None, verdict, since_s, why, since_s, until_s)


def as_json(claims: Sequence[Claim]) -> list[dict[str, Any]]:
    """The claims as in ``summary.json``; numbers that are not finite become null."""
    return [{key: _plain(value) for key, value in claim._asdict().items()} for claim in claims]


def _plain(value: Any) -> Any:
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, StrEnum) else value
