"""The size of the problem that a loop's model poses, which is known before any inequality is computed."""

from collections.abc import Iterable, Iterator, Mapping

from flint import arb, fmpq

from noack.proof.elaborate.hybrid_system import Model
from noack.proof.elaborate.loop import Loop
from noack.proof.elaborate.tables import read_count
from noack.proof.search.results import MOST_LATER, read_assumptions
from noack.theory.witnesses.effort import TooLargeError, too_large

_PER_ENTRY = 20_000
"""What the solver needs for each entry of an inequality, in products."""


def work_of(sizes: Iterable[int]) -> float:
    """Return about how many 10⁹ products the solver needs per step for inequalities of some sizes."""
    entries = [size * (size + 1) / 2 for size in sizes]
    return sum(count**3 + _PER_ENTRY * count for count in entries) / 1e9


def require_small(loop: Loop, rate: arb, document: Mapping[str, object], most: float) -> None:
    """Raise TooLargeError, with what would be small enough, if a document's problem needs more work."""
    if (work := work_of_loop(loop, rate, document)) > most:
        raise TooLargeError(f"{too_large(work, most)}; {_what_fits(loop, rate, document, most)}")


def work_of_loop(loop: Loop, rate: arb, document: Mapping[str, object]) -> float:
    """Return the work for one output."""
    assumed = read_assumptions(loop, rate, document)
    model = Model(loop, rate, arb(1), assumed.errors, assumed.noise, **assumed.of_model, is_exact=False)
    return work_of(problem_sizes(model))


def problem_sizes(model: Model) -> Iterator[int]:
    """Yield the sizes of the inequalities that bound ‖x‖ in the limit, which are as many as for others."""
    noise = model.bounds.columns.ncols()
    for index, place in enumerate(model.locations):
        size = len(place.coordinates) + (noise if place.silent else 0)
        ends = max(2 * (len(place.nodes) - 1), 1)
        if blocks := model.block_sizes(index):
            size -= sum(blocks)
            yield from blocks * (ends + len(place.nodes))
        for _ in range(ends):
            yield from (size + len(flow.unknowns) for flow in place.flows)
        yield from (size for _ in place.nodes)
    for edge in model.edges:
        size = len(model.locations[edge.source].coordinates) + (noise if edge.is_test else 0)
        yield from (size for _ in edge.pairs)
    if model.memory is not None:
        yield from (1 for _ in model.locations)


def _what_fits(loop: Loop, rate: arb, document: Mapping[str, object], most: float) -> str:
    """Return in words how many losses, or which delay, would make a loop's problem small enough."""

    def fits(smaller: Loop, **counts: int) -> bool:
        return work_of_loop(smaller, rate, {**document, **counts}) <= most

    fewer_losses = reversed(range(loop.losses))
    losses = next((count for count in fewer_losses if fits(loop._replace(losses=count))), None)
    found = [] if losses is None else [f"at most {losses} consecutive losses"]
    later, at_start = (read_count(document, name, MOST_LATER) for name in ("later", "later_at_start"))
    for fewer in reversed(range(later)):
        delay = (fewer + 1) * loop.times.least_apart  # no more events may happen within it
        times = loop.times._replace(delay=delay, start=min(loop.times.start, delay))
        if fits(loop._replace(times=times), later=fewer, later_at_start=min(fewer, at_start)):
            found.append(f"updates that act within {_ms(delay)} of their event, {_ms(loop.times.delay)} now")
            break
    if not found:
        return "neither fewer losses nor shorter delays alone make them small enough"
    return f"small enough: {'; or '.join(found)}"


def _ms(time: fmpq) -> str:
    return f"{1e3 * float(arb(time).mid()):g} ms"
