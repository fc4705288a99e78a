"""Bounds of a scenario that the checker has proven, with their witnesses.

The search takes some seconds to minutes; what it finds is verified by :mod:`noack_check`, which derives
the loop from the resolved scenario itself.
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple

from cosim.analysis.witness_store import StoredSearch, WitnessStore
from noack.core.errors import CallerError
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import with_stated_times
from noack.theory.certificates.proven_bounds import ProvenBounds
from noack.theory.witnesses.documents import Witness, find_witness
from noack.theory.witnesses.effort import MOST_WORK, NoWitnessError
from noack.theory.witnesses.outward import proven_bounds
from noack_check.check import RejectedError
from noack_check.keys import RefusedError
from noack_check.loop import Loop
from noack_check.proof import Proof, prove
from noack_check.scenario import read_loop


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
    bounds: ProvenBounds | None = None
    """What is proven, as certificates have it."""


class Unproven(NamedTuple):
    """Plants and conditions of which nothing is proven."""

    plants: str
    conditions: str
    reason: str


class Witnesses(NamedTuple):
    """All statements of a scenario, and the scenario that they are about."""

    scenario: dict[str, object]
    """As `noack check --resolved` prints it."""
    statements: Sequence[WitnessedStatement]

    @property
    def are_any(self) -> bool:
        """Whether something is proven."""
        return any(statement.proof is not None for statement in self.statements)

    @property
    def unproven(self) -> list[Unproven]:
        """Of what nothing is proven."""
        return [Unproven(s.plants, s.conditions, s.reason) for s in self.statements if s.proof is None]

    def file_text(self) -> str:
        """Return the file that ``noack-check`` reads."""
        documents = [s.document for s in self.statements if s.document is not None]
        return json.dumps({"scenario": self.scenario, "statements": documents}, allow_nan=False)


def find_witnesses(
    resolved: Scenario,
    late_periods: int,
    progress: Callable[[float], None] = lambda share: None,
    most_work: float = MOST_WORK,
) -> Witnesses:
    """Search for witnesses of a resolved scenario's bounds, for its plant and its uncertainty box.

    Args:
        resolved: the scenario.
        late_periods: allowed lateness in steps of the plant.
        progress: called with the completed share.
        most_work: limit of each search, see :class:`noack.theory.witnesses.effort.Effort`.
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
        found.append(find_statement(content, plants, under, part, most_work))
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
    most_work: float = MOST_WORK,
) -> WitnessedStatement:
    """Search for the witness of one statement of a resolved scenario: its plants and conditions.

    The outputs that the scenario states have bounds under the schedule. Where disturbances or noise act, ‖x‖
    and each output have bounds in the limit t → ∞, too.
    """
    try:
        loop = read_loop(content, box=plants == "box", ideal=conditions == "ideal")
        has_outputs = conditions == "schedule"
        witness = known_or_found(loop, progress, most_work, has_outputs=has_outputs)
    except (RefusedError, NoWitnessError) as error:
        return WitnessedStatement(plants, conditions, None, None, str(error))
    document = {"plants": plants, "conditions": conditions, **witness.document}
    bounds = proven_bounds(witness.proof, loop)
    return WitnessedStatement(plants, conditions, document, witness.proof, "", bounds)


def known_or_found(
    loop: Loop, progress: Callable[[float], None], most_work: float, *, has_outputs: bool = True
) -> Witness:
    """Return the witness of a loop that was found earlier, or search for it, unless the limit of work is 0.

    Raises:
        NoWitnessError: none was found.
    """
    rows = tuple(f"y[{j}]" for j in range(loop.output_rows.nrows())) if has_outputs else ()
    outputs = ("x", "e_c", *(rows if loop.outputs.nrows() else ()))
    ultimate = ("x", *rows) if has_outputs and (loop.sizes or loop.noise.ncols()) else ()
    wanted = (*outputs, *(f"{output} in the limit" for output in ultimate))
    store = WitnessStore(loop)
    known = store.read(wanted, most_work)
    if known is not None and known.document is None:
        raise NoWitnessError(known.reason)
    if known is not None and known.document is not None:
        with suppress(RejectedError):  # it was changed
            return Witness(known.document, prove(loop, known.document))
    if not most_work:
        raise NoWitnessError("no witness was found earlier")
    try:
        witness = find_witness(loop, outputs, ultimate=ultimate, progress=progress, most_work=most_work)
    except NoWitnessError as error:
        store.write(StoredSearch(None, str(error)), wanted, most_work)
        raise
    bounds = witness.proof.bounds
    bounded = [bound.output if bound.from_start else f"{bound.output} in the limit" for bound in bounds]
    store.write(StoredSearch(witness.document, bounded=bounded), wanted, most_work)
    return witness
