"""Bounds of a scenario that the checker has proven, with their witnesses.

The search takes some seconds to minutes; what it finds is verified by :mod:`noack_check`, which derives
the loop from the resolved scenario itself.
"""

import json
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

from noack.core.errors import CallerError
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import with_stated_times
from noack.theory.witnesses.documents import find_witness
from noack.theory.witnesses.effort import NoWitnessError
from noack_check.keys import RefusedError
from noack_check.proof import Proof
from noack_check.scenario import read_loop
from noack_check.sentences import sentences


class WitnessedStatement(NamedTuple):
    """What is proven for some plants under some conditions, or why nothing is."""

    plants: str
    """"own" or "box"."""
    conditions: str
    """"ideal" or "schedule"."""
    document: dict[str, object] | None
    proof: Proof | None
    reason: str = ""
    """Why there is no witness."""

    def to_json(self) -> dict[str, object]:
        """Return what is proven, without the witness."""
        proven = [] if self.proof is None else list(sentences(self.proof))
        return {"plants": self.plants, "conditions": self.conditions, "proven": proven, "reason": self.reason}


class Witnesses(NamedTuple):
    """All statements of a scenario, and the scenario that they are about."""

    scenario: dict[str, object]
    """As `noack check --resolved` prints it."""
    statements: Sequence[WitnessedStatement]

    @property
    def are_any(self) -> bool:
        """Whether something is proven."""
        return any(statement.proof is not None for statement in self.statements)

    def file_text(self) -> str:
        """Return the file that ``noack-check`` reads."""
        documents = [s.document for s in self.statements if s.document is not None]
        return json.dumps({"scenario": self.scenario, "statements": documents}, allow_nan=False)


def find_witnesses(
    resolved: Scenario, late_periods: int, progress: Callable[[float], None] = lambda share: None
) -> Witnesses:
    """Search for witnesses of a resolved scenario's bounds, for its plant and its uncertainty box.

    Args:
        resolved: the scenario.
        late_periods: allowed lateness in steps of the plant.
        progress: called with the completed share.
    """
    content = resolved_content(resolved, late_periods)
    has_box = resolved.plant.uncertainty_A is not None or resolved.plant.uncertainty_B is not None
    wanted = [
        (plants, under)
        for under in ("ideal", "schedule")
        for plants in ("own", *(["box"] if has_box else []))
    ]
    found = []
    for index, (plants, under) in enumerate(wanted):
        part = partial(_part_of, progress, index, len(wanted))
        found.append(find_statement(content, plants, under, part))
    progress(1.0)
    return Witnesses(content, found)


def _part_of(progress: Callable[[float], None], index: int, count: int, share: float) -> None:
    """Report the progress of one of several searches."""
    progress((index + share) / count)


def needs_matrices(resolved: Scenario) -> str:
    """Return why a plant that is not linear by its settings has no witness."""
    kind = resolved.plant.system.kind
    return f'plant.system.kind = "{kind}": witnesses are for a plant with A and B in the scenario'


def require_covered(resolved: Scenario, late_periods: int) -> None:
    """Raise CallerError if the checker covers a scenario neither under its schedule nor under ideal ones."""
    if not resolved.coverage.is_linear:
        raise CallerError(f"--witness: {needs_matrices(resolved)}")
    content = resolved_content(resolved, late_periods)
    for ideal in (False, True):
        try:
            read_loop(content, box=False, ideal=ideal)
        except RefusedError as error:
            if ideal:
                raise CallerError(f"--witness: {error}") from None
        else:
            return


def no_witnesses(resolved: Scenario, reason: str) -> Witnesses:
    """Return that nothing is proven of a scenario."""
    content: dict[str, object] = {"name": resolved.name}
    return Witnesses(content, [WitnessedStatement("own", "schedule", None, None, reason)])


def resolved_content(resolved: Scenario, late_periods: int) -> dict[str, object]:
    """Return the tables of a resolved scenario, as `noack check --resolved` prints them."""
    certificate = resolved.certificate.model_copy(update={"late_periods": late_periods})
    stated = with_stated_times(resolved.model_copy(update={"certificate": certificate}))
    return dict(stated.content())


def find_statement(
    content: dict[str, object],
    plants: str,
    conditions: str,
    progress: Callable[[float], None] = lambda share: None,
) -> WitnessedStatement:
    """Search for the witness of one statement of a resolved scenario: its plants and conditions.

    Where disturbances or noise act, ‖x‖ and each state have bounds in the limit t → ∞, too, under the
    schedule.
    """
    try:
        loop = read_loop(content, box=plants == "box", ideal=conditions == "ideal")
        has_limit = bool(loop.sizes or loop.noise.ncols()) and conditions == "schedule"
        states = ("x", *(f"x[{i}]" for i in range(loop.n))) if has_limit else ()
        witness = find_witness(loop, ultimate=states, progress=progress)
    except (RefusedError, NoWitnessError) as error:
        return WitnessedStatement(plants, conditions, None, None, str(error))
    document = {"plants": plants, "conditions": conditions, **witness.document}
    return WitnessedStatement(plants, conditions, document, witness.proof)
