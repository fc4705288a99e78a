"""Times between events (rule R10): how far a row may grow after it was reset.

A row here is Rz, where −Rż + MRz = y is an output with a proven bound |y| ≤ D, D² = D1² f1² + D2² f2². If
|Rz| ≤ N just after an edge, N² = N1² f1² + N2² f2², then a time T later, if no edge changed Rz,

    |Rz| ≤ g N + I D,  g = sup ‖e^{(M + r)s}‖ and I = ∫ ‖e^{(M + r)s}‖ ds over 0 ≤ s ≤ T,

by the variation of constants; r is the rate of f1, so that f1 is the one at the later time. An edge whose
facts need a larger |Rz| is not taken within T.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from flint import arb, arb_mat, fmpq, fmpq_mat

from noack_kernel.document import Document, Edge, Location, Output, Table, fields, mapping, strings
from noack_kernel.exact import Matrix, RejectedError, is_positive, rational, read_matrix, square, unit_rows
from noack_kernel.forms import facts_at, of_facts, of_units, read_above, read_levels

Levels = tuple[fmpq, fmpq]
"""The squares of two numbers a and b of a bound (a² f1² + b² f2²)^½."""

_CELLS = 64
_SQUARINGS = 14
"""A norm is too large by a factor of q^(2^−15) at most, q being its number of rows."""


@dataclass(frozen=True)
class EventTimes:
    """Two events are at least ``apart`` s apart; None: only that some edges are never taken is proven."""

    apart: fmpq | None
    inside: tuple[str, ...]
    """The locations in which the loop is after both events, and between them."""
    never: tuple[str, ...]
    """Edges with ``to: null`` that are never taken."""
    inequalities: int


class ResetRows:
    """An entry of a proof about the growth of rows after edges that reset them.

    Args:
        document: what the loop is.
        entry: of the proof.
        levels: D1² and D2² of proven bounds from the start on, by the names of outputs.

    Raises:
        RejectedError: it is malformed.
    """

    def __init__(self, document: Document, entry: Table, levels: Mapping[str, Levels]) -> None:
        kind = "apart" if "apart" in entry else "never"
        optional = {"split"}
        fields(entry, "times", {"output", "matrix", "after", "reach", "multipliers", kind}, optional)
        self._document = document
        name = entry["output"]
        if not isinstance(name, str) or name not in levels:
            raise RejectedError("times: the output has no bound from the start on")
        self._output, self._deviation = document.outputs[name], levels[name]
        self._matrix, self.rows = _read_rows(document, self._output, entry["matrix"])
        self._after = read_levels(document, "times", entry["after"])
        self._reach = read_levels(document, "times", entry["reach"])
        self._split = rational(entry["split"]) if "split" in entry else None
        self._multipliers = mapping(entry["multipliers"], "times")
        self._used: set[str] = set()
        self._count = 0
        self._apart = rational(entry["apart"]) if kind == "apart" else None
        self._never = [] if kind == "apart" else self._dead_edges(strings(entry["never"], "times"))

    def _dead_edges(self, names: Sequence[str]) -> list[Edge]:
        edges = {edge.name: edge for edge in self._document.edges if edge.target is None}
        unknown = [name for name in names if name not in edges]
        if not names or unknown:
            raise RejectedError(f"times: {(unknown or [''])[0][:40]!r} is no edge that leads nowhere")
        return [edges[name] for name in names]

    def verify(self) -> EventTimes:
        """Verify it.

        Raises:
            RejectedError: the first inequality that is not proven, or multipliers that belong to none.
        """
        if self._apart is not None:
            self._verify_apart(self._apart)
        for edge in self._never:
            self._verify_never(edge)
        if unused := sorted({*self._multipliers} - self._used):
            raise RejectedError(f"times: multipliers of {unused[0][:80]!r}, which is no inequality")
        never = tuple(edge.name for edge in self._never)
        return EventTimes(self._apart, self._output.locations, never, self._count)

    def _verify_apart(self, apart: fmpq) -> None:
        """No event follows another one within ``apart`` once the loop is where the output has a bound.

        If the loop starts there, the start counts as an event. Other edges leave Rz as it is there, and lead
        to nowhere else.
        """
        document, inside = self._document, {*self._output.locations}
        if any(edge.duration > 0 for edge in document.edges):
            raise RejectedError("times: an edge lasts")
        if apart <= 0:
            raise RejectedError("times: two events are not a time above 0 apart")
        live = [edge for edge in document.edges if edge.target is not None]
        events = [edge for edge in live if edge.event and edge.target in inside]
        if not events:
            raise RejectedError("times: no edge is an event")
        for edge in live:
            if edge.target not in inside and edge.source in inside:
                raise RejectedError(f"times: {edge.name} leads to where the output has no bound")
            if not edge.event and edge.source in inside and not self._is_kept(edge):
                raise RejectedError(f"times: {edge.name} changes the rows, and is no event")
        self._require_reach(apart)
        if document.start in inside:  # then the start counts as an event
            self._verify_start()
        for edge in events:
            self._verify_reset(edge)
            self._verify_excluded(edge)

    def _verify_never(self, edge: Edge) -> None:
        """The source is entered by events only, which set its clock to 0."""
        document, source = self._document, self._document.locations[edge.source]
        if any(other.duration > 0 for other in document.edges):
            raise RejectedError("times: an edge lasts")
        entries = [other for other in document.edges if other.target == source.name]
        if source.name not in self._output.locations or edge.last is None:
            raise RejectedError(f"times: {edge.name}: no bound of the output, or of the clock")
        is_start = document.start == source.name
        if is_start or any(not other.event or other.clock != "zero" for other in entries):
            raise RejectedError(f"times: {source.name} is entered without an event that begins its clock")
        for other in entries:
            self._verify_reset(other)
        self._require_reach(edge.last)
        self._verify_excluded(edge)

    # The steps.

    def _is_kept(self, edge: Edge) -> bool:
        """Return whether an edge leaves Rz as it is, exactly."""
        J, source = edge.jump, self._document.locations[edge.source]
        kept = [*source.coordinates, *self._document.noise]
        return (self.rows @ J - self.rows).is_zero(range(self.rows.height), kept)

    def _verify_reset(self, edge: Edge) -> None:
        """N1² f1² + N2² f2² + Σ m q − |RJz|² ⪰ 0: so large is Rz just after it."""
        source = self._document.locations[edge.source]
        M = of_units(self._document, self._after) - square(self.rows @ edge.jump)
        self._require(f"after/{edge.name}", M, facts_at(self._document, edge), source)

    def _verify_start(self) -> None:
        """N1² f1² + N2² f2² + Σ m q − |Rz(0)|² ⪰ 0: the same of the start."""
        document, Z = self._document, self._document.start_columns
        M = Z.T @ of_units(document, self._after) @ Z - square(self.rows @ Z)
        M += of_facts(document, "start", self._numbers("start", {"facts"}), document.start_facts, Z)
        self._count += 1
        if not is_positive(M):
            raise RejectedError("times: not proven at the start")

    def _verify_excluded(self, edge: Edge) -> None:
        """|Rz|² − E1² f1² − E2² f2² + Σ m q − ε f² ⪰ 0: the facts need a larger |Rz| than what is reached."""
        place = f"edge/{edge.name}"
        above = mapping(mapping(self._multipliers.get(place, {}), place).get("above", {}), place)
        M = square(self.rows) - of_units(self._document, self._reach)
        M -= read_above(self._document, place, above)
        source = self._document.locations[edge.source]
        self._require(place, M, facts_at(self._document, edge), source)

    def _require(self, name: str, M: Matrix, facts: Sequence[str], source: Location) -> None:
        z = unit_rows(range(self._document.size), self._document.size)
        M += of_facts(self._document, name, self._numbers(name, {"facts", "above"}), facts, z)
        kept = [*source.coordinates, *self._document.noise]
        self._count += 1
        if not is_positive(M.take(kept, kept)):
            raise RejectedError(f"times: not proven at {name}")

    def _numbers(self, name: str, keys: set[str]) -> Table:
        table = mapping(self._multipliers.get(name, {}), name)
        fields(table, name, set(), keys)
        self._used.add(name)
        return table

    def _require_reach(self, within: fmpq) -> None:
        """E² ≥ (1 + s) g² N² + (1 + 1/s) I² D² in each unit, with any s > 0: then E ≥ g N + I D.

        What E1² lacks may be a part of E2², since f1 ≤ f2.
        """
        shift = identity(self._matrix.nrows()) * self._document.rate
        largest, total = growth(arb_mat(self._matrix + shift), arb(within))
        split = self._split
        if split is None and any(level > 0 for level in self._after):
            raise RejectedError("times: a split is missing")
        if split is not None and split <= 0:
            raise RejectedError("times: a split is not above 0")
        lacking = arb(0)
        for reach, after, deviation in zip(self._reach, self._after, self._deviation, strict=True):
            needed = total**2 * arb(deviation)
            if split is not None:
                needed = (1 + 1 / arb(split)) * needed + (1 + arb(split)) * largest**2 * arb(after)
            lacking = (lacking + needed - arb(reach)).max(arb(0))
        if not lacking == 0:
            raise RejectedError("times: the rows may reach more within the time")


def _read_rows(document: Document, output: Output, value: object) -> tuple[fmpq_mat, Matrix]:
    """Return M and R of an output y = −Rż + MRz, with exact entries and without noise."""
    if output.velocity is None or output.rows is None:
        raise RejectedError("times: the output has no velocity")
    rows = output.velocity.times(fmpq(-1))
    M = read_matrix(value, rows.height, rows.height)
    if M.radius is not None or rows.radius is not None or not (M @ rows).equals(output.rows):
        raise RejectedError("times: the output is not −Rż + MRz with this matrix, exactly")
    if not rows.is_zero(range(rows.height), document.noise):
        raise RejectedError("times: noise has a part in the rows")
    return M.mid, rows


def identity(size: int) -> fmpq_mat:
    """Return the identity matrix."""
    return unit_rows(range(size), size).mid


def growth(G: arb_mat, until: arb) -> tuple[arb, arb]:
    """Return upper bounds of sup ‖e^{Gs}‖ and of ∫ ‖e^{Gs}‖ ds over 0 ≤ s ≤ ``until``."""
    if all(entry == 0 for entry in G.entries()):
        return arb(1), until
    largest, total, step = arb(1), arb(0), until / _CELLS
    half = (step / 2).upper()  # a cell is within [0, 2 half]
    within, forward = (G * arb(half, half)).exp(), (G * step).exp()
    edge = arb_mat(identity(G.nrows()))
    for _ in range(_CELLS):
        norm = spectral_norm(edge * within)
        largest, total = largest.max(norm), total + step * norm
        edge = edge * forward
    return arb(largest.abs_upper()), arb(total.abs_upper())


def spectral_norm(M: arb_mat) -> arb:
    """Return an upper bound of ‖M‖: the root of trace((MᵀM)^k)^(1/k), k = 2^14."""
    power = M.transpose() * M
    for _ in range(_SQUARINGS):
        power = power * power
    trace = sum((power[i, i] for i in range(power.nrows())), arb(0))
    return arb(trace.abs_upper()).root(2 ** (_SQUARINGS + 1))
