"""The loop document and the proof of a margin: what the kernel has proven of it.

One document has the losses that destabilise; statements about fewer losses are about the runs that visit only
some of its locations.
"""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

from netem.core.number_format import at_least, at_most
from noack.proof.forms_proof import FORMAT, as_text
from noack.proof.period_document import PeriodDocument
from noack.proof.period_graph import PeriodGraph, each_step
from noack.scenario.outputs import LoopOutput
from noack.theory.witnesses.loss_margin import LossMargin, Stability
from noack.theory.witnesses.period_bounds import BoundSearch
from noack.theory.witnesses.period_growth import GrowthSearch
from noack.theory.witnesses.period_loops import Entry
from noack_kernel import GrowthStatement, Proven, RejectedError, Statement, prove

_SHARES = (0.5, 0.8, 0.95)
"""Of the rate at which the loop decays: rates of bounds that are tried."""
_MOST_FLOWS = 600
"""Flows of all edges of a document for which bounds are looked for."""
_WEIGHT = 10.0
"""Of the part of a bound that does not decay."""


class MarginProof(NamedTuple):
    """What the kernel has proven, and the two files."""

    proven: Sequence[str]
    """Sentences."""
    document: str
    proof: str

    @property
    def lines(self) -> list[str]:
        """What is proven, a line each."""
        return [f"proved by noack-check: {sentence}" for sentence in self.proven]


def margin_proof(
    margin: LossMargin, found: Sequence[Stability], outputs: Sequence[LoopOutput], losses: int
) -> MarginProof | None:
    """Return the proofs for the most losses with which a loop is stable, and those that destabilise it.

    Args:
        margin: of the scenario.
        found: what is known for 0, 1, … consecutive losses.
        outputs: of the scenario; their bounds are proven for its own losses.
        losses: most consecutive losses of the scenario.

    Returns:
        None if the loop has no document, or nothing was proven.
    """
    stable = max(
        (k for k, growth in enumerate(found) if growth.upper < 1 and "most" in growth.entries), default=None
    )
    unstable = min(
        (k for k, growth in enumerate(found) if growth.lower > 1 and "least" in growth.entries), default=None
    )
    if stable is None and unstable is None:
        return None
    files = _Files(margin, max(number for number in (stable, unstable) if number is not None))
    growth = list[Entry]()
    if stable is not None and (most := files.at_most(stable, found[stable])) is not None:
        growth.append(most)
    if unstable is not None:
        growth.append(dict(found[unstable].entries["least"]))
    bounds = list[Entry]()
    if stable is not None and losses <= stable and found[losses].upper < 1:
        bounds = files.find_bounds(outputs, losses, found[losses])
    document, proof, proven = files.proven(bounds, growth)
    sentences = [*_of_growth(proven.growth, margin, stable, unstable)]
    sentences += [*_of_bounds(proven.bounds, outputs, losses)]
    return MarginProof(sentences, document, proof) if sentences else None


class _Files:
    """The document of a margin, with bounds that decay at a rate, and proofs of it.

    Args:
        margin: of the scenario.
        losses: most consecutive losses of the document.
    """

    def __init__(self, margin: LossMargin, losses: int) -> None:
        self._margin, self._losses = margin, losses
        self._guarantee = margin.guarantee.capped(losses)
        self._document = PeriodDocument(margin.period_loop, self._guarantee)

    def _graph(self, losses: int) -> PeriodGraph:
        """Return the part of the document with at most so many losses."""
        kept = [name for name, lost in self._document.lost.items() if lost <= losses]
        return PeriodGraph(self._document.table, kept)

    def at_most(self, losses: int, growth: Stability) -> Entry | None:
        """Return the proof of the largest growth with at most so many losses."""
        if losses == self._losses:
            return dict(growth.entries["most"])
        return GrowthSearch(self._graph(losses)).at_most(float(growth.entries["most"]["factor"]))

    def find_bounds(self, outputs: Sequence[LoopOutput], losses: int, growth: Stability) -> list[Entry]:
        """Return the proofs of bounds with at most so many losses; none if none was found.

        The document then has the rate with which the output is soonest within what is allowed.
        """
        asked = [output for output in outputs if output.allowed is not None] or [*outputs]
        if not asked or not self._is_small(losses):
            return []
        decay = -math.log(growth.upper) / self._margin.seconds(self._margin.longest)
        best: tuple[float, list[Entry], PeriodDocument] | None = None
        for share in _SHARES:
            rate = float(f"{share * decay:.3g}")
            self._document = PeriodDocument(self._margin.period_loop, self._guarantee, rate)
            search, entries = BoundSearch(self._graph(losses)), list[Entry]()
            for output in asked:
                entry = search.bound(output.name, _WEIGHT)
                if entry is not None and self._is_proven(entry):
                    entries.append(entry)
            settled = [_settled(entry, output, rate) for entry, output in zip(entries, asked, strict=False)]
            if len(entries) == len(asked) and (best is None or max(settled) < best[0]):
                best = max(settled), entries, self._document
        if best is None:
            return []
        self._document = best[2]
        return best[1]

    def _is_small(self, losses: int) -> bool:
        """Return whether the flows of all edges are few enough for bounds."""
        edges = self._graph(losses).edges
        return (
            sum(sum(not isinstance(step, str) for step in each_step(e.steps)) for e in edges) <= _MOST_FLOWS
        )

    def _is_proven(self, entry: Entry) -> bool:
        try:
            self.proven([entry], [])
        except RejectedError:
            return False
        return True

    def proven(self, bounds: Sequence[Entry], growth: Sequence[Entry]) -> tuple[str, str, Proven]:
        """Return the contents of both files, and what the kernel proves."""
        document = as_text(self._document.table)
        digest = hashlib.sha256(document.encode()).hexdigest()
        proof = as_text({"format": FORMAT, "document": digest, "bounds": bounds, "growth": growth})
        return document, proof, prove(document, proof)


def _settled(entry: Entry, output: LoopOutput, rate: float) -> float:
    """Return from which time on an output is within what is allowed, in s; without a limit its bound."""
    decaying, constant = (math.sqrt(level) for level in entry["levels"])
    if output.allowed is None:
        return decaying / rate
    if constant >= output.allowed:
        return math.inf
    return max(math.log(decaying / (output.allowed - constant)) / rate, 0.0) if decaying else 0.0


def _of_growth(
    statements: Sequence[GrowthStatement], margin: LossMargin, stable: int | None, unstable: int | None
) -> Iterator[str]:
    """Yield what is proven of the growth."""
    per = f"per {margin.seconds(margin.longest):g} s, in the long run"
    late = f", inputs up to {margin.late} steps late" if margin.late else ""
    ties = ", each update at whichever of two ticks" if margin.ties else ""
    for statement in statements:
        factor = float(statement.factor) ** margin.between[-1]
        if statement.is_upper:
            yield (
                f"with at most {stable} lost in a row{late}{ties}, every pattern is stable: the difference "
                f"of two runs changes at most by the factor {at_most(factor)} {per}"
            )
        else:
            yield (
                f"with {unstable} lost in a row a pattern is unstable: a difference of two runs grows at "
                f"least by the factor {at_least(factor)} {per}"
            )


def _of_bounds(statements: Sequence[Statement], outputs: Sequence[LoopOutput], losses: int) -> Iterator[str]:
    """Yield what is proven of the outputs."""
    allowed = {output.name: output.allowed for output in outputs}
    for statement in statements:
        text = f"with at most {losses} lost in a row, {replace(statement, only=None)}"
        limit, rate = allowed[statement.output], float(statement.rate)
        constant, decaying = float(statement.constant), float(statement.decaying)
        if limit is not None and constant < limit and decaying > 0 and rate > 0:
            settled = max(math.log(decaying / (limit - constant)) / rate, 0.0)
            text += f"; so within {limit:g} {statement.unit} from {math.ceil(settled * 1000) / 1000:g} s on"
        yield text
