"""The search for witnesses of the growth of a loop that transmits at least at some times.

They are documents for :mod:`noack.proof.search.growth`. Nothing here has to be right: that module tests in
balls what is found, and returns the bounds that it has accepted.

1. A cycle of bursts with the largest growth gives the lower bound ρ.
2. For a growth γ little above ρ, Clarabel looks for quadratic forms, one for each node, with the smallest
   violation of M'PM ⪯ γ²ᵈP. Products of several bursts must then be short enough, as the checker will find.
3. If these do not end, nodes that remember the last bursts are tried, and then a larger γ.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from noack.core.linear_systems import Matrix, Stack, Vector, balancing_exponents
from noack.proof.elaborate.errors import RejectedError
from noack.proof.search.growth import Burst, Growth, PeriodicLoop, prove_growth, remembering
from noack.proof.semidefinite import Accuracy, MatrixInequality, minimise
from noack.theory.time_triggered.graph import Graph
from noack.theory.witnesses.coordinates import floats
from noack.theory.witnesses.effort import NoWitnessError
from noack.theory.witnesses.outward import above, below

Document = dict[str, object]
ACCURACY = 2e-4
"""Wanted upper/lower − 1 over the longest time between two transmissions: some four digits of the growth."""
_COARSER, _COARSEST = 2.0, 1e3
"""Factor by which the accuracy becomes coarser after a proof that failed, and the largest one."""
_ONLY_CYCLE = 1e-6
"""The same of a graph with one cycle, for which quadratic forms exist for every growth above its own."""
_SOLVED = Accuracy(gap=1e-5, feasibility=1e-7, improves_steps=False)
_LEVEL_WEIGHT = 1e-6
"""Weight of the largest entry of the forms in their search, relative to what they violate."""
_MOST_ENTRIES, _MOST_REMEMBERED = 6000, 1500
"""Entries of all forms for which they are searched; for more, one form stands for all nodes."""
_MOST_MEMORY, _MOST_TRANSITIONS = 3, 300
"""Bursts that nodes may remember, and the transitions of the graph with such nodes."""
_FIRST_BURSTS, _FURTHER_BURSTS, _ATTEMPTS = 250, 50, 5
"""Bursts whose inequalities are solved at first, and of the fastest ones added each time; attempts."""
_MOST_PRODUCTS = 4000
"""Products that a proof may need; the checker takes some 0.1 ms for each."""
_LONGEST_PRODUCT = 24
"""Bursts of a product: the checker's balls become larger with each."""
_ROUNDED = 1e-9
"""By so much more than γ, relatively, a witness claims, so that rounding does not decide."""
_CYCLE_BURSTS, _MOST_CYCLE_BURSTS = 40, 60
"""Bursts of the longest cycles, and those in a graph of more nodes."""
_BEAM, _LEAST_BEAM = 300, 20
"""Paths that are continued."""
_MOST_MULTIPLICATIONS = 1e7
"""Of the products of a length: for more the beam is narrower."""
_THRESHOLD_SHARE = 0.1
"""A growth below 1 by this share of its distance from the lower bound is proven."""
_SQUARINGS = range(40, 2, -2)
"""Of a pattern's product, until its trace is known: more are more accurate, but lose digits."""
_WORST_CONDITION = 1e12
"""Of eigenvectors as coordinates."""
_SMALLEST = 1e-200
"""Growth to the power of a burst's duration that counts as 0."""


class GrowthBounds(NamedTuple):
    """Bounds of the growth over the longest time between two transmissions, which the checker accepted."""

    lower: float
    """0: no cycle was found that grows."""
    upper: float
    """Infinity: none was proven."""
    cycle: tuple[Burst, ...]
    """The bursts of the pattern that grows at least so fast, in their order of time."""
    stable: Document | None = None
    """The witness of the upper bound."""
    unstable: Document | None = None
    """The witness of the lower bound."""


class _System(NamedTuple):
    """The graph of a loop in floating point."""

    graph: Graph
    matrices: Stack
    """In similar units."""
    units: Vector
    """The similar units of z, powers of two, (N,)."""

    def in_coordinates(self, T: Stack) -> Stack:
        """Return the matrices in the coordinates T x, with a T for each node."""
        return np.asarray(T[self.graph.targets] @ self.matrices @ np.linalg.inv(T)[self.graph.sources])


def enclose_growth(
    loop: PeriodicLoop, accuracy: float = ACCURACY, *, decide: bool = True, effort: float = 1.0
) -> GrowthBounds:
    """Bound the growth of all patterns that a loop's guarantee allows.

    Args:
        loop: the loop.
        accuracy: wanted upper/lower − 1 over the longest time between two transmissions.
        decide: whether bounds on both sides of 1 are improved.
        effort: factor of the limit of the work for that.

    Raises:
        RefusedError: the guarantee allows too many patterns.
        OverflowError: the loop grows too much between two deliveries.
    """
    systems = [_system(loop, loop.bursts)]
    found = _with_cycle(loop, systems[0], GrowthBounds(0.0, np.inf, ()))
    effort = effort if decide and found.lower < 1 else 0.0
    return _with_forms(loop, systems, found, accuracy / loop.between[-1], effort)


def _system(loop: PeriodicLoop, bursts: Sequence[Burst]) -> _System:
    matrices = np.array([floats(loop.matrix(burst)) for burst in bursts])
    if not np.isfinite(matrices).all():
        raise OverflowError
    ends = ((burst.source, burst.target, burst.units) for burst in bursts)
    graph = Graph(*(np.array(column) for column in zip(*ends, strict=True)))
    exponents = balancing_exponents(np.abs(matrices).max(axis=0))
    return _System(graph, np.ldexp(matrices, exponents[:, None] - exponents), np.ldexp(1.0, exponents))


def _with_cycle(loop: PeriodicLoop, system: _System, found: GrowthBounds) -> GrowthBounds:
    """Return the bounds with the lower one of the fastest cycle that is found."""
    graph = system.graph
    path = graph.only_cycle()
    if path is None:
        length = min(max(_CYCLE_BURSTS, graph.nodes), _MOST_CYCLE_BURSTS)
        work = max(map(len, graph.leaving)) * loop.size**3
        beam = max(min(_BEAM, int(_MOST_MULTIPLICATIONS / work)), _LEAST_BEAM)
        balanced = system.in_coordinates(graph.balancing(system.matrices))
        _, path = graph.fastest_cycle(balanced, length, beam)
    bursts = tuple(loop.bursts[number] for number in path)
    try:
        document, growth = unstable_document(loop, bursts)
    except NoWitnessError:
        return found
    lower = 0.0 if growth.lower is None else below(growth.lower)
    return found._replace(lower=lower, cycle=bursts, unstable=document)


def _with_forms(
    loop: PeriodicLoop, systems: list[_System], found: GrowthBounds, accuracy: float, effort: float
) -> GrowthBounds:
    """Return the bounds with the upper one of the first forms that prove one, if it is smaller.

    Args:
        loop: the loop.
        systems: its graph, and those whose nodes remember bursts, as far as they are known.
        found: the bounds until now.
        accuracy: wanted upper/lower − 1 per unit.
        effort: factor of the limit of the work for a growth below 1; 0: it is not tried.
    """
    lower, longest = found.lower ** (1 / loop.between[-1]), loop.between[-1]
    system, is_only = systems[0], systems[0].graph.only_cycle() is not None
    if is_only:
        accuracy = min(accuracy, _ONLY_CYCLE / longest)
    least = max(lower, _SMALLEST ** (1 / int(system.graph.durations.max())))
    limit = 1 - _THRESHOLD_SHARE * (1 - lower) if effort else np.inf
    while accuracy < _COARSEST:
        growth, products = least * (1 + accuracy), _MOST_PRODUCTS
        if growth >= limit:
            growth, products, limit = limit, int(10 * effort * _MOST_PRODUCTS), np.inf
        for memory in range(_MOST_MEMORY + 1):
            if memory == len(systems) and not _remember(loop, systems):
                break
            remembered = systems[memory]
            T = _only_coordinates(remembered, growth) if is_only else _coordinates(remembered, growth)
            if T is None or not _products_end(remembered, T, growth, products):
                continue
            scaled = T * system.units
            forms = [(P + P.T).tolist() for P in scaled.swapaxes(1, 2) @ scaled / 2]
            stable = {"factor": growth * (1 + _ROUNDED), "memory": memory, "forms": forms}
            document: Document = {"losses": loop.guarantee.longest_burst, "stable": stable}
            try:
                proven = prove_growth(loop, document)
            except RejectedError:
                continue
            if proven.upper is not None and (upper := above(proven.upper)) < found.upper:
                return found._replace(upper=upper, stable=document)
            return found
        accuracy *= _COARSER
    return found


def _remember(loop: PeriodicLoop, systems: list[_System]) -> bool:
    """Add the graph whose nodes remember one burst more; return False if it is too large."""
    memory, last = len(systems), systems[-1].graph
    transitions = int(np.bincount(last.sources, minlength=last.nodes)[last.targets].sum())
    is_large = len(last.sources) * loop.size * (loop.size + 1) // 2 > _MOST_REMEMBERED
    if is_large or transitions > _MOST_TRANSITIONS or last.only_cycle() is not None:
        return False
    systems.append(_system(loop, remembering(loop.bursts, memory)))
    return True


def _only_coordinates(system: _System, growth: float) -> Stack | None:
    """Return coordinates, (nodes, N, N), in which the only cycle of a graph grows by less than γ."""
    from scipy.linalg import solve_discrete_lyapunov  # slow to import

    graph, path = system.graph, system.graph.only_cycle() or ()
    balancing = graph.balancing(system.matrices)
    matrices = system.in_coordinates(balancing)
    steps = matrices / (growth**graph.durations)[:, None, None]
    n = matrices.shape[1]
    around, sums = np.eye(n), np.zeros((n, n))
    for number in path:
        sums += around.T @ around
        around = steps[number] @ around
    forms = np.empty((graph.nodes, n, n))
    following = solve_discrete_lyapunov(around.T, sums)
    for number in reversed(path):
        forms[graph.targets[number]] = following
        following = np.eye(n) + steps[number].T @ following @ steps[number]
    return _factors(forms, balancing)


def _coordinates(system: _System, growth: float) -> Stack | None:
    """Return coordinates T, (nodes, N, N), in which bursts hardly grow by more than γ per unit.

    TᵀT are the quadratic forms with the smallest violation. It is found of some bursts, and of further
    ones that they leave growing.
    """
    graph, entries = system.graph, system.matrices.shape[1] * (system.matrices.shape[1] + 1) // 2
    searched = system
    if graph.nodes * entries > _MOST_ENTRIES:
        everywhere = np.zeros_like(graph.sources)
        searched = _System(Graph(everywhere, everywhere, graph.durations), system.matrices, system.units)
    balancing = searched.graph.balancing(system.matrices)
    matrices = searched.in_coordinates(balancing)
    steps = matrices / (growth**graph.durations)[:, None, None]
    count = len(steps)
    spread = np.unique(np.linspace(0, count - 1, _FIRST_BURSTS).astype(np.int64))
    numbers = np.union1d([edges[0] for edges in searched.graph.leaving], spread)
    for _ in range(_ATTEMPTS):
        forms = _forms(searched.graph.at(numbers), steps[numbers])
        T = None if forms is None else _factors(forms, balancing)
        if T is None or len(numbers) == count:
            break
        sizes = np.linalg.norm(searched.in_coordinates(T), 2, axis=(1, 2)) / growth**graph.durations
        if sizes.max() <= max(sizes[numbers].max(), 1.0) * (1 + _ROUNDED):
            break
        numbers = np.union1d(numbers, np.argsort(-sizes)[:_FURTHER_BURSTS])
    return None if T is None else np.broadcast_to(T, (graph.nodes, *T.shape[1:]))


def _forms(graph: Graph, steps: Stack) -> Stack | None:
    """Return forms, (nodes, N, N), with P_v − MᵀP_wM ⪰ −s for the smallest s; None: the solver fails."""
    identity = np.eye(steps.shape[1])
    problem = []
    for node in map(str, range(graph.nodes)):
        problem.append(MatrixInequality(((node, identity / 2, identity),), (), -identity))
        level = (("level", identity),)
        problem.append(MatrixInequality(((node, -identity / 2, identity),), level, 0 * identity))
    for source, target, M in zip(graph.sources, graph.targets, steps, strict=True):
        parts = ((str(source), identity / 2, identity), (str(target), -M / 2, M))
        problem.append(MatrixInequality(parts, (("violation", identity),), 0 * identity))
    objective = {"violation": 1.0, "level": _LEVEL_WEIGHT}
    answer = minimise(objective, problem, margin=0.0, accuracy=_SOLVED)
    forms = np.array([answer.matrices[str(node)] for node in range(graph.nodes)])
    return forms if np.isfinite(forms).all() else None


def _factors(forms: Stack, balancing: Stack) -> Stack | None:
    """Return T with TᵀT the forms, which are in balanced coordinates; None: they are not definite."""
    try:
        roots = np.linalg.cholesky((forms + forms.swapaxes(1, 2)) / 2)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(roots.swapaxes(1, 2) @ balancing)


def _products_end(system: _System, T: Stack, growth: float, most: int) -> bool:
    """Return whether every path has a beginning that grows by less than γ, with so many products at most."""
    graph = system.graph
    steps = system.in_coordinates(T) / (growth**graph.durations)[:, None, None]
    ends, products, count = np.arange(graph.nodes), np.tile(np.eye(steps.shape[1]), (graph.nodes, 1, 1)), 0
    for _ in range(_LONGEST_PRODUCT):
        continued = [graph.leaving[end] for end in ends]
        count += sum(map(len, continued))
        if count > most + len(steps):
            return False
        step = np.concatenate(continued)
        products = steps[step] @ np.repeat(products, [len(edges) for edges in continued], axis=0)
        grows = ~(np.linalg.norm(products, 2, axis=(1, 2)) < 1)
        if not grows.any():
            return True
        ends, products = graph.targets[step][grows], products[grows]
    return False


def unstable_document(loop: PeriodicLoop, path: Sequence[Burst]) -> tuple[Document, Growth]:
    """Return a document that proves the growth of a pattern of bursts, and what the checker finds.

    Raises:
        NoWitnessError: it is not accepted.
    """
    why, coordinates = "no pattern", _eigenvectors(loop, path)
    pattern = "".join("D" + "L" * burst.losses for burst in path)
    intervals = [units for burst in path for units in intervals_of(burst, loop.between)]
    arrivals = [
        0 if burst.arrival is None else loop.times.arrivals(burst.slot).index(burst.arrival) for burst in path
    ]
    for squarings in _SQUARINGS if path else ():
        table = {"pattern": pattern, "slot": path[0].slot, "squarings": squarings}
        table |= {"coordinates": coordinates.tolist()} if coordinates is not None else {}
        if any(arrivals):
            table["arrivals"] = arrivals
        if len(loop.between) > 1:
            table["intervals"] = intervals
        document: Document = {"losses": loop.guarantee.longest_burst, "unstable": table}
        try:
            return document, prove_growth(loop, document)
        except RejectedError as error:
            why = str(error)
    raise NoWitnessError(why)


def _eigenvectors(loop: PeriodicLoop, path: Sequence[Burst]) -> Matrix | None:
    """Return real coordinates in which the product of a cycle is nearly diagonal, if there are some."""
    product = reduce(lambda before, burst: floats(loop.matrix(burst)) @ before, path, np.eye(loop.size))
    largest = np.abs(product).max()
    if not 0 < largest < np.inf:
        return None
    values, vectors = np.linalg.eig(product / largest)
    basis = np.where(values.imag >= 0, vectors.real, vectors.imag)
    return basis if np.linalg.cond(basis) < _WORST_CONDITION else None


def intervals_of(burst: Burst, between: range) -> list[int]:
    """Return times between the transmissions of a burst, (losses + 1,), in units; the longest first.

    ``between`` are those that are possible.
    """
    intervals, remaining = [], burst.units
    for further in range(burst.losses, -1, -1):
        intervals.append(min(between[-1], remaining - further * between[0]))
        remaining -= intervals[-1]
    return intervals
