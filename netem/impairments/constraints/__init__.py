"""Constraints on the losses of a flow, one kind per file; with the cap they are the guarantee.

A constraint allows every delivery, whatever was lost before. So a network can always keep it.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from netem.core.settings_section import kinds_in, union_of
from netem.guarantee.loss_guarantee import LongestBurst, LossGuarantee
from netem.impairments.feature import Constraint

_KINDS = kinds_in(__name__, Constraint)
CONSTRAINTS = tuple(_KINDS.values())

if TYPE_CHECKING:
    AnyConstraint = Constraint
else:
    AnyConstraint = union_of(_KINDS)


def join_guarantee(mansd: int | None, constraints: Sequence[AnyConstraint]) -> LossGuarantee:
    """Return the rules of cap and constraints together."""
    cap = () if mansd is None else (LongestBurst(mansd),)
    return LossGuarantee((*cap, *(constraint.rule for constraint in constraints)))


def require_consistent(mansd: int | None, constraints: Sequence[AnyConstraint]) -> None:
    """Check that the constraints can be enforced together.

    Raises:
        ValueError: they cannot; the message begins with the key.
    """
    scopes: set[str] = set()
    for number, constraint in enumerate(constraints):
        if constraint.scope in scopes:
            raise ValueError(
                f"constraints.{number}: {constraint.text()}: there is a {constraint.scope} already"
            )
        scopes.add(constraint.scope)
    if constraints and join_guarantee(mansd, constraints).longest_burst is None:
        raise ValueError(
            f"constraints: {constraints[0].text()}: needs a maximum of losses, too: mansd or at_most (atmost)"
        )
