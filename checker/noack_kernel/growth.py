"""R8: how fast the state of a document without motions grows, at most and at least.

Here z has the coordinates without units and noise, which are 0: the difference of two runs that have the same
loads moves so. J is the product of an edge's steps, and P the form of a location.

* At most: P ≻ 0 in some locations, through which each cycle leads, and g^{2T/U} zᵀP_s z − (Jz)ᵀP_t(Jz) ⪰ 0
  for each edge of the duration T. Then zᵀPz grows at most by g² over the period U. Where an edge does not
  obey this, or leads to a location without a form, it suffices that all paths that begin with it do so after
  some edges: each path is divided into such beginnings.
* At least: a cycle of edges has the product Π over the time T, and s = g^{T/U}. If Π has a real eigenvalue
  above s, which the sign of det(s − Π) shows, or below −s, or if zᵀ(ΠᵀPΠ − s²P)z ⪰ 0 and vᵀPv > 0, so that
  vᵀPv grows by s² from round to round, then some z grows by at least g over the period U.
"""

from collections.abc import Mapping, Sequence
from itertools import pairwise

from flint import arb, arb_mat, fmpq

from noack_kernel.document import Document, Edge, Location, Table, fields, mapping, names_of, strings
from noack_kernel.exact import (
    Matrix,
    RejectedError,
    from_balls,
    is_definite,
    is_positive,
    rational,
    read_matrix,
    symmetric,
    times_power,
    to_balls,
    unit_rows,
)
from noack_kernel.forms import visited
from noack_kernel.jumps import Repeat

MOST_PRODUCTS, LONGEST_PATH = 20_000, 500
"""Of paths of several edges, and their edges."""
LONGEST_CYCLE = 2000
_ONE = fmpq(1)
_MOST_BITS = 512
"""Of the power of the factor over a path; a longer one is rounded down."""


class Growth:
    """An entry of a proof about growth, which has to be verified.

    Args:
        document: what the loop is.
        entry: of the proof.

    Raises:
        RejectedError: it is malformed, or the document has motions.
    """

    def __init__(self, document: Document, entry: Table) -> None:
        fields(entry, "growth", {"factor", "period"}, {"forms", "only", "cycle", "sign", "form", "vector"})
        self._document = document
        self.factor, self.period = rational(entry["factor"]), rational(entry["period"])
        if not (self.factor > 0 and self.period > 0):
            raise RejectedError("growth: a factor or a period that is not above 0")
        self.is_upper = "forms" in entry
        if self.is_upper == ("cycle" in entry):
            raise RejectedError("growth: it has either forms or a cycle")
        self.locations, self._edges = visited(document, entry.get("only"))
        if any(location.motion for location in document.locations.values()):
            raise RejectedError("growth: the document has motions")
        if any(not _is_exact(edge) for edge in document.edges):
            raise RejectedError("growth: a jump has an interval, in which two runs may differ")
        self._entry = entry
        self.cycle: tuple[str, ...] = ()
        self._homogeneous = [i for i in document.states if i not in document.units]

    def verify(self) -> int:
        """Verify all inequalities, and return how many; raise RejectedError if one is not proven."""
        return self._verify_forms() if self.is_upper else self._verify_cycle()

    def _power(self, duration: fmpq, before: fmpq = _ONE) -> fmpq:
        """Return g^{T/U} times what is before it, where T is a multiple of U."""
        times = duration / self.period
        if times.q != 1 or times > 10**6:
            raise RejectedError("growth: a duration is no multiple of the period")
        return times_power(before, self.factor, int(times.p))

    # At most.

    def _verify_forms(self) -> int:
        fields(self._entry, "growth", {"factor", "period", "forms"}, {"only"})
        table = mapping(self._entry["forms"], "forms")
        fields(table, "forms", set(), {*self.locations})
        forms = {name: self._form(self.locations[name], rows) for name, rows in table.items()}
        self._require_forms(forms)
        leaving = {name: [edge for edge in self._edges if edge.source == name] for name in self.locations}
        count, products = len(forms), 0
        for name, P in forms.items():
            paths = [(edge, self._state_map(edge), self._power(edge.duration), 1) for edge in leaving[name]]
            while paths:
                edge, J, power, length = paths.pop()
                count += 1
                if edge.target in forms:
                    after = J.T @ forms[edge.target] @ J
                    if self._is_above(name, P.times(power * power) - after):
                        continue
                following = leaving[str(edge.target)]
                products += len(following)
                if length == LONGEST_PATH or products > MOST_PRODUCTS:
                    raise RejectedError(
                        f"growth: not proven of paths from {name!r} that end with {edge.name!r}"
                    )
                for each in following:
                    further = from_balls(to_balls(self._state_map(each)) * to_balls(J))
                    longer = _short(self._power(each.duration, power))
                    paths.append((each, further, longer, length + 1))
        return count

    def _require_forms(self, forms: Mapping[str, Matrix]) -> None:
        """Require that each cycle of edges comes through a location that has a form."""
        left = {
            name: {edge.target for edge in self._edges if edge.source == name}
            for name in self.locations
            if name not in forms
        }
        while ends := [name for name, targets in left.items() if not targets & {*left}]:
            for name in ends:
                del left[name]
        if left:
            raise RejectedError(f"growth: no form in a cycle through {min(left)!r}")

    def _form(self, location: Location, rows: object) -> Matrix:
        """Return P of a location, on the coordinates of the homogeneous part that it has."""
        inside = [i for i in location.coordinates if i in self._homogeneous]
        P = symmetric(location.name, rows, len(inside))
        if not is_definite(P):
            raise RejectedError(f"growth: the form of {location.name!r} is not positive definite")
        lift = unit_rows([self._homogeneous.index(i) for i in inside], len(self._homogeneous))
        return lift.T @ P @ lift

    def _is_above(self, source: str, M: Matrix) -> bool:
        inside = self._document.locations[source].coordinates
        kept = [k for k, i in enumerate(self._homogeneous) if i in inside]
        return is_positive(M.take(kept, kept))

    def _state_map(self, edge: Edge) -> Matrix:
        if edge.target is None:
            raise RejectedError(f"growth: {edge.name!r} leads nowhere")
        return edge.jump.take(self._homogeneous, self._homogeneous)

    # At least.

    def _verify_cycle(self) -> int:
        document, size = self._document, len(self._homogeneous)
        fields(self._entry, "growth", {"factor", "period", "cycle"}, {"sign", "form", "vector"})
        edges = {edge.name: edge for edge in document.edges}
        self.cycle = tuple(strings(self._entry["cycle"], "cycle"))
        if not 0 < len(self.cycle) <= LONGEST_CYCLE:
            raise RejectedError(f"growth: not from 1 to {LONGEST_CYCLE} edges in the cycle")
        names_of([*{*self.cycle}], edges, "cycle")
        path = [edges[name] for name in self.cycle]
        self._require_cycle(path)
        product, duration = to_balls(unit_rows(range(size), size)), fmpq(0)
        for edge in path:
            product, duration = to_balls(self._state_map(edge)) * product, duration + edge.duration
        if not duration > 0:
            raise RejectedError("growth: no time passes in the cycle")
        # Coordinates that the location lacks are 0 before and after the cycle.
        inside = [k for k, i in enumerate(self._homogeneous) if i in self._inside(path[0])]
        size, kept = len(inside), from_balls(product).take(inside, inside)
        product, least = to_balls(kept), self._power(duration)
        if "sign" in self._entry:
            if "form" in self._entry or "vector" in self._entry:
                raise RejectedError("growth: a sign and a form")
            proven = _has_eigenvalue_beyond(product, least, self._entry["sign"])
        else:
            P = symmetric("cycle", self._entry.get("form"), size)
            v = to_balls(read_matrix(self._entry.get("vector"), size, 1))
            form = to_balls(P)
            grows = product.transpose() * form * product - form * arb(least * least)
            proven = is_positive(from_balls(grows)) and (v.transpose() * form * v)[0, 0] > 0
        if not proven:
            raise RejectedError(
                f"growth: the cycle is not proven to grow by {float(arb(self.factor).mid()):g}"
            )
        return 1

    def _inside(self, edge: Edge) -> tuple[int, ...]:
        return self._document.locations[edge.source].coordinates

    def _require_cycle(self, path: Sequence[Edge]) -> None:
        """Require edges that follow each other, return to their beginning, may be taken, and be reached."""
        for edge, following in pairwise([*path, path[0]]):
            if edge.target != following.source:
                raise RejectedError(f"growth: {following.name!r} does not follow {edge.name!r}")
        document = self._document
        for location in {edge.source for edge in path}:
            if document.locations[location].facts:
                raise RejectedError(f"growth: {location!r} has facts")
        reached, count = set[str](), -1
        if not document.locations[document.start].facts:
            reached = {document.start}
        while len(reached) > count:
            count = len(reached)
            reached |= {str(e.target) for e in document.edges if e.source in reached and self._is_free(e)}
        if not all(self._is_free(edge) for edge in path) or path[0].source not in reached:
            raise RejectedError("growth: the cycle has facts, or is not reached from the start")

    def _is_free(self, edge: Edge) -> bool:
        """Return whether an edge may be taken by each z, but for bounds of loads, which are 0 here."""
        if edge.target is None or self._document.locations[edge.target].facts:
            return False
        return all(self._is_of_noise(fact) for fact in edge.facts)

    def _is_of_noise(self, fact: str) -> bool:
        """Return whether a fact only bounds noise by units, so that it holds where noise is 0."""
        Q = self._document.facts[fact]
        if not Q.is_zero(self._homogeneous, range(self._document.size)):
            return False
        units = self._document.units
        return is_positive(Q.take(units, units).times(fmpq(-1)))


def _short(power: fmpq) -> fmpq:
    """Return a number that is at most a power of the factor, close to it, and has few digits."""
    return power if power.height_bits() <= _MOST_BITS else arb(power).lower().fmpq()


def _is_exact(edge: Edge) -> bool:
    """Return whether the file has no interval in the jump or the steps of an edge: all runs have one map."""
    if not edge.steps:
        return edge.jump.radius is None
    return all(
        one.matrix.radius is None
        for step in edge.steps
        for one in (step.steps if isinstance(step, Repeat) else [step])
    )


def _has_eigenvalue_beyond(M: arb_mat, least: fmpq, sign: object) -> bool:
    """Return whether M has a real eigenvalue above s, or below −s: det(s − M), or det(s + M), is below 0."""
    if sign not in ("positive", "negative"):
        raise RejectedError("growth: the sign of an eigenvalue is positive or negative")
    size = M.nrows()
    shift = arb_mat(size, size, [arb(least if i == j else 0) for i in range(size) for j in range(size)])
    return bool((shift - M if sign == "positive" else shift + M).det() < 0)
