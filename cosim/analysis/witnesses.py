"""Bounds of a scenario that the kernel, or the checker of gains, has proven, with their witnesses.

The search takes some seconds to minutes. What it finds becomes a document and a proof (:mod:`noack.proof`).
"""

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import NamedTuple, TypeVar

import numpy as np
from flint import fmpq

from cosim.analysis.witness_store import StoredSearch, WitnessStore
from noack.core.linear_systems import Vector
from noack.core.progress import Progress, no_progress, part_of
from noack.plants.systems.equation_text import equation_lines
from noack.plants.systems.traced_equations import NotEnclosedError, TracedEquations, trace
from noack.proof.elaborate.errors import RefusedError, RejectedError
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.scenario import Enclosed as EnclosedPlant
from noack.proof.elaborate.scenario import read_loop, read_region
from noack.proof.elaborate.tables import read_table
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement
from noack.scenario.resolution import loop_of
from noack.scenario.scenario import Scenario
from noack.theory.certificates.conditions import with_stated_numbers
from noack.theory.certificates.plant_equations import equations_of
from noack.theory.certificates.proven_bounds import ProvenBounds
from noack.theory.witnesses.documents import Witness, find_witness, forms_or_gains, witness_by_gains
from noack.theory.witnesses.effort import MOST_WORK, NoWitnessError
from noack.theory.witnesses.outward import proven_bounds
from noack.theory.witnesses.regions import (
    PlantOnRegions,
    find_region_witness,
    is_enclosed_everywhere,
    region_table,
    region_witness_by_gains,
)

_T = TypeVar("_T")
_MOST_KEPT = 300
"""Results of one kind that are kept in a process."""
_NEAR = 1e-3
"""The equations near 0, in multiples of typical sizes: they tell searches for other plants apart."""


class WitnessedStatement(NamedTuple):
    """What is proven for some plants under some conditions, or why nothing is."""

    plants: str
    """"own", "box" or "region", of a plant's equations."""
    conditions: str
    """"ideal" or "schedule"."""
    document: dict[str, object] | None
    proof: Proof | None
    reason: str = ""
    """Why there is no witness."""
    bounds: ProvenBounds | None = None
    """What is proven, as certificates have it."""
    loop: Loop | None = None
    """What it is proven of."""


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

    def equations_text(self) -> str:
        """Return the equations that the statements are about, for ``noack-check --equations``."""
        documents = [s.document for s in self.statements if s.document is not None]
        found = [equation_lines(read_table(d, "equations")) for d in documents if "equations" in d]
        blocks = dict.fromkeys("".join(f"{line}\n" for line in lines) for lines in found)
        return "\n".join(blocks)


def plants_of(resolved: Scenario) -> list[str]:
    """Return the plants of a scenario's statements: "own", or "region" of equations, and "box"."""
    if not resolved.coverage.is_linear:
        return ["region"]
    has_box = resolved.plant.uncertainty_A is not None or resolved.plant.uncertainty_B is not None
    return ["own", "box"] if has_box else ["own"]


def find_witnesses(
    resolved: Scenario,
    progress: Progress = no_progress,
    most_work: float = MOST_WORK,
    conditions: Sequence[str] = ("ideal", "schedule"),
    near: Sequence[Mapping[str, object]] = (),
    plants: Sequence[str] | None = None,
) -> Witnesses:
    """Search for witnesses of a resolved scenario's bounds, for its plant and its uncertainty box.

    Args:
        resolved: the scenario.
        progress: called with the completed share.
        most_work: limit of each search, see :class:`noack.theory.witnesses.effort.Effort`.
        conditions: "ideal" and "schedule", or one of them.
        near: documents of similar scenarios.
        plants: some of :func:`plants_of`; by default all.
    """
    wanted = [(of, under) for under in conditions for of in plants or plants_of(resolved)]
    found: list[WitnessedStatement] = []
    for index, (of, under) in enumerate(wanted):
        part = part_of(progress, index / len(wanted), (index + 1) / len(wanted))
        known = [*near] if of == "region" else []  # other searches of ideal conditions are short
        if under == "schedule":
            found_near = (s for s in found if s.plants == of or s.conditions == under)
            known = [*near, *(s.document for s in found_near if s.document and of != "region")]
        found.append(find_statement(resolved, of, under, part, most_work, known))
    progress(1.0)
    return Witnesses(resolved_content(resolved), found)


def resolved_content(resolved: Scenario) -> dict[str, object]:
    """Return the tables of a resolved scenario, as `noack check --resolved` prints them."""
    return dict(with_stated_numbers(resolved).content())


def with_lateness(resolved: Scenario, late_periods: int) -> Scenario:
    """Return a scenario whose certificates allow for another lateness, in steps of the plant."""
    certificate = resolved.certificate.model_copy(update={"late_periods": late_periods})
    return resolved.model_copy(update={"certificate": certificate})


def find_statement(
    resolved: Scenario,
    plants: str,
    conditions: str,
    progress: Progress = no_progress,
    most_work: float = MOST_WORK,
    near: Sequence[Mapping[str, object]] = (),
    *,
    longer: Mapping[str, fmpq] | None = None,
) -> WitnessedStatement:
    """Search for the witness of one statement of a resolved scenario: its plants and conditions.

    The outputs that the scenario states have bounds under the schedule. Where disturbances or noise act, ‖x‖
    and each output have bounds in the limit t → ∞, too.

    Args:
        resolved: the scenario.
        plants: one of :func:`plants_of`.
        conditions: "ideal" or "schedule".
        progress: called with the completed share.
        most_work: limit of the search; 0: a witness that is known, or one by gains.
        near: documents of other statements of the scenario.
        longer: some of the loop's times are at least these, in s.
    """
    content, has_outputs = resolved_content(resolved), conditions == "schedule"
    try:
        if plants == "region":
            plant = plant_on_regions(resolved, content, conditions, longer)
            witness, loop = known_or_found_on_region(
                plant, progress, most_work, has_outputs=has_outputs, near=near
            )
        else:
            loop = read_loop(content, box=plants == "box", ideal=conditions == "ideal", longer=longer)
            witness = known_or_found(loop, progress, most_work, has_outputs=has_outputs, near=near)
        bounds = proven_bounds(witness.proof, loop)
    except (RefusedError, NoWitnessError, NotEnclosedError) as error:
        return WitnessedStatement(plants, conditions, None, None, str(error))
    document = {"plants": plants, "conditions": conditions, **witness.document}
    return WitnessedStatement(plants, conditions, document, witness.proof, "", bounds, loop)


def plant_on_regions(
    resolved: Scenario,
    content: Mapping[str, object],
    conditions: str,
    longer: Mapping[str, fmpq] | None = None,
) -> PlantOnRegions:
    """Return the loop of a resolved scenario with its plant's equations, for any region.

    Args:
        resolved: the scenario.
        content: its tables, as :func:`resolved_content` returns them.
        conditions: "ideal" or "schedule".
        longer: some of the loop's times are at least these, in s.

    Raises:
        NotEnclosedError: the plant has no equations.
    """
    loop, system = loop_of(resolved), equations_of(resolved)

    def on(widths: Vector) -> tuple[TracedEquations, Loop]:
        traced, table = trace(system, loop.n, loop.m, widths), {"region": region_table(widths, loop.n)}
        enclosed = EnclosedPlant(traced.plants, read_region(table, loop.n, loop.m))
        is_ideal = conditions == "ideal"
        return traced, read_loop(content, box=False, ideal=is_ideal, enclosed=enclosed, longer=longer)

    size = float(np.abs(loop.x0).max()) or 1.0
    typical = size * np.concatenate([np.ones(loop.n), np.abs(loop.K).sum(axis=1)])
    return PlantOnRegions((*loop.state_names, *loop.input_names), loop.n, typical, on)


def known_or_found(
    loop: Loop,
    progress: Progress,
    most_work: float,
    *,
    has_outputs: bool = True,
    near: Sequence[Mapping[str, object]] = (),
) -> Witness:
    """Return the witness of a loop that was found earlier, or search for it.

    With a limit of work of 0 it is one by gains. ``near`` has documents of similar loops.

    Raises:
        NoWitnessError: none was found.
    """
    outputs, ultimate = _wanted(loop, has_outputs=has_outputs)

    def search() -> Witness:
        if not most_work:
            return witness_by_gains(loop, (*outputs, "e_s", *ultimate))
        return find_witness(
            loop, outputs, ultimate=ultimate, near=near, progress=progress, most_work=most_work
        )

    return _known_or_found(
        WitnessStore(loop),
        outputs,
        ultimate,
        most_work,
        search,
        partial(prove_statement, loop),
    )


def _wanted(loop: Loop, *, has_outputs: bool) -> tuple[Sequence[str], Sequence[str]]:
    """Return the outputs to bound from the start on, and in the limit."""
    rows = tuple(f"y[{j}]" for j in range(loop.output_rows.nrows())) if has_outputs else ()
    outputs = ("x", *(rows if loop.outputs.nrows() else ()), "e_c")  # the drift bounds e_c, too
    is_disturbed = loop.until is None and bool(loop.sizes or loop.noise.ncols())
    return outputs, (("x", *rows) if has_outputs and is_disturbed else ())


def known_or_found_on_region(
    plant: PlantOnRegions,
    progress: Progress,
    most_work: float,
    *,
    has_outputs: bool = True,
    near: Sequence[Mapping[str, object]] = (),
) -> tuple[Witness, Loop]:
    """Return the witness of a plant on a region, as :func:`known_or_found`, and the loop there.

    Raises:
        NoWitnessError: none was found.
        NotEnclosedError: the equations have no enclosure near 0.
    """
    equations, loop = plant.on(_NEAR * plant.typical)
    outputs, ultimate = _wanted(loop, has_outputs=has_outputs)

    def search() -> Witness:
        def by_gains() -> Witness:
            return region_witness_by_gains(plant, (*outputs, "e_s", *ultimate))

        if not most_work:
            return by_gains()
        by_forms = partial(find_region_witness, plant, outputs, ultimate=ultimate, near=near)
        by_forms = partial(by_forms, progress=progress, most_work=most_work)
        return forms_or_gains(by_forms, by_gains) if is_enclosed_everywhere(plant) else by_forms()

    def loop_on(document: Mapping[str, object]) -> Loop:
        region = read_region(document, loop.n, loop.B.ncols())
        widths = [np.inf if limit is None else float(limit) for limit in (*region.x, *region.u)]
        return plant.on(np.array(widths))[1]

    def proven(document: Mapping[str, object]) -> Proof:
        return prove_statement(loop_on(document), document)

    store = WitnessStore((loop, equations.document))
    witness = _known_or_found(
        store,
        outputs,
        ultimate,
        most_work,
        search,
        proven,
    )
    return witness, loop_on(witness.document)


def _known_or_found(
    store: WitnessStore,
    outputs: Sequence[str],
    ultimate: Sequence[str],
    most_work: float,
    search: Callable[[], Witness],
    proven: Callable[[Mapping[str, object]], Proof],
) -> Witness:
    """Return what is stored, if it is proven, or what a search finds."""
    wanted = (*outputs, *(f"{output} in the limit" for output in ultimate))
    known = store.read(wanted, most_work)
    if known is not None and known.document is None:
        raise NoWitnessError(known.reason)
    if known is not None and known.document is not None:
        key = store.name, _digest(known.document)
        with suppress(RejectedError, NotEnclosedError):  # it was changed
            if key not in _proofs:
                _keep(_proofs, key, proven(known.document))
            return Witness(known.document, _proofs[key])
    if not most_work:
        return _by_gains(store, wanted, search)
    try:
        witness = search()
    except NoWitnessError as error:
        store.write(StoredSearch(None, str(error)), wanted, most_work)
        raise
    store.write(StoredSearch(witness.document), wanted, most_work)
    return witness


_proofs = dict[tuple[str, str], Proof]()
"""What the checker has proven in this process, by loop and document: loops with equal numbers share it."""


def _digest(document: Mapping[str, object]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _keep(known: dict[tuple[str, str], _T], key: tuple[str, str], value: _T) -> None:
    if len(known) >= _MOST_KEPT:
        known.clear()
    known[key] = value


_found_by_gains = dict[tuple[str, tuple[str, ...]], Witness | str]()
"""What was found without a search in this process, or why nothing was."""


def _by_gains(store: WitnessStore, wanted: tuple[str, ...], search: Callable[[], Witness]) -> Witness:
    """Return what is found without a search; loops with equal numbers share it."""
    key, known = (store.name, wanted), _found_by_gains
    if key not in known:
        if len(known) >= _MOST_KEPT:
            known.clear()
        try:
            known[key] = search()
        except NoWitnessError as error:
            known[key] = str(error)
    if isinstance(found := known[key], str):
        raise NoWitnessError(found)
    return found
