"""What the sensor takes for the state at a test: x + n, with n = Ss + Σ column p, |p| ≤ f₁ = e^{−rt} or ≤ 1.

Without an observer n is the noise of a measurement. The error of an observer's estimate does not depend on
the rest of the loop, if the plant has the matrices that the observer uses. With its gain L_k at test k:

    n_k = (I − L_k C) (e^{AT} n_{k−1} − ∫₀ᵀ e^{As} D d ds) + L_k v_k,   n_0 = (I − L₀C) (x̂ − x)(0) + L₀ v_0.

All is in coordinates of W n. Of L_k, and so of the factor F_k of n_{k−1}, balls are known, which are the same
from some k on. n̂ has their midpoints in its equation:

* What follows from the start is F_k ⋯ F₁ (I − L₀C) (x̂ − x)(0). Ss with ṡ = Λs is near it at the tests, if a
  witness names suitable S, Λ and s(0); the difference decays as f₁.
* What follows from noise v and disturbances d has a constant bound, the largest sum of all
  |F_k ⋯ F_{j+1} S_j|; the radii of S_j are columns of S_j, too.
* The difference of n and n̂ follows from the radii of the factors, times n: of the start's part as f₁.

Products are found up to one that is small.
"""

from collections.abc import Sequence
from functools import reduce
from typing import NamedTuple

from flint import arb, arb_mat, fmpq

from noack.core.balls import beside, columns_of, frobenius, identity, upto
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.loop import Loop, LoopObserver, Noise, Smooth, no_smooth

_MOST_POWERS, _SMALL = 20_000, 1e-6
_CELLS, _MOST_CELLS = 100, 16
"""Parts of the time 1/‖A‖, and most parts of the time between two measurements."""
_LITTLE = 0.01
"""A decaying bound below such a share of the constant one is added to it."""
_MOST_ENTRIES = 50_000_000
"""Of terms that are added: half a minute."""
_LATELY = 8
"""So many errors are kept, with their bounds, as they do not depend on r."""


class _Error(NamedTuple):
    """The error W n of an observer, in coordinates of W, with exact numbers in the place of balls."""

    first: arb_mat  # its columns are what follows from the start at test 0, and its radii
    factors: tuple[arb_mat, ...]  # F_k: at tests 1, 2, …; the last one at all later ones
    radii: arb_mat  # (n, n), diagonal: the sums of the largest radii of F_k, by rows
    sums: Sequence[Sequence[arb]]
    """Bounds of what follows from noise and disturbances at tests 0, 1, …, by entries; the last ones stay."""
    shares: Sequence[arb]
    """The difference of n and n̂ is at most these shares of the largest n, by entries."""


def noise_of(loop: Loop, rate: arb, smooth: Smooth | None = None) -> Noise:
    """Return bounds of n; without ``smooth`` s = 0.

    Raises:
        RejectedError: the error of the observer is not proven to decay as fast as f₁.
    """
    if loop.observer is None:
        return loop.plain_noise
    error, T = _error_of(loop, loop.observer), arb(loop.observer.period)
    growth = arb((rate * T).exp().upper())
    rest, size = _from_start(loop, error, T, growth, smooth)
    early, constant = _early(error.sums, growth), [*error.sums[-1]]
    largest = size + frobenius(_column([a + b for a, b in zip(early, constant, strict=True)]))
    shares = error.shares
    if not loop.needs_constant:  # then all follows from the start
        shares = _most(_sums_by_test([growth * F for F in error.factors], [growth * error.radii]))
    if not (kept := 1 - frobenius(_column(shares))) > 0:
        raise RejectedError("observer: its gains are not known well enough")
    blurred = constant if loop.needs_constant else rest
    blurred[:] = [
        arb((each + share * largest / kept).abs_upper()) for each, share in zip(blurred, shares, strict=True)
    ]
    rest = [arb((a + b).abs_upper()) for a, b in zip(rest, early, strict=True)]
    size = size / kept + frobenius(_column(early))
    sizes = size, frobenius(_column(constant))
    if not loop.has_decaying_unit(rate):
        sizes, rest, constant = (
            (arb(0), sizes[0] + sizes[1]),
            [],
            [a + b for a, b in zip(rest, constant, strict=True)],
        )
    for i, little in enumerate(rest):
        if loop.needs_constant and little <= _LITTLE * constant[i]:
            rest[i], constant[i] = arb(0), constant[i] + little
    inverse = loop.weight.inv()
    chosen = [[(i, size) for i, size in enumerate(bounds) if size > 0] for bounds in (rest, constant)]
    columns = [size * columns_of(inverse, [i]) for bounds in chosen for i, size in bounds]
    entries = [column[i, 0] for i in range(loop.n) for column in columns]
    return Noise(arb_mat(loop.n, len(columns), entries), len(chosen[0]), smooth or no_smooth(loop.n), sizes)


_Parts = tuple[tuple[arb_mat, ...], tuple[tuple[arb_mat, ...], fmpq, int]]
_known: list[tuple[_Parts, _Error]] = []


def _error_of(loop: Loop, observer: LoopObserver) -> _Error:
    """Return the error of an observer; of the last ones it is known."""
    matrices = loop.A, loop.weight, loop.noise, loop.pushes, observer.outputs, observer.start
    parts = (*matrices, _column(loop.sizes)), (observer.gains, observer.period, observer.unfelt)
    for (known, numbers), error in _known:
        is_same = numbers[0] is observer.gains and numbers[1:] == parts[1][1:]
        if is_same and all(_are_equal(M, other) for M, other in zip(known, parts[0], strict=True)):
            return error
    error = _new_error(loop, observer)
    _known[:] = [(parts, error), *_known[: _LATELY - 1]]
    return error


def _are_equal(M: arb_mat, other: arb_mat) -> bool:
    """Return whether all entries are the same exact numbers."""
    is_like = (M.nrows(), M.ncols()) == (other.nrows(), other.ncols())
    return is_like and all(a == b for a, b in zip(M.entries(), other.entries(), strict=True))


def _new_error(loop: Loop, observer: LoopObserver) -> _Error:
    W, flow, n = loop.weight, (arb(observer.period) * loop.A).exp(), loop.n
    tests = range(1, max(len(observer.gains), 2))
    factors = [W * observer.correction(k) * flow * W.inv() for k in tests]
    sources = [_sources(loop, observer, k) for k in (0, *tests)]
    first = W * observer.correction(0) * observer.start
    radii, blur = (_diagonal([_largest_radius(blocks, i) for i in range(n)]) for blocks in (factors, sources))
    exact = tuple(F.mid() for F in factors)
    first = beside(first.mid(), _diagonal([_radius(first, i) for i in range(n)]))
    sums = _sums_by_test(exact, [beside(S.mid(), blur) if S.ncols() else S for S in sources])
    return _Error(first, exact, radii, sums, _most(_sums_by_test(exact, [radii])))


def _sources(loop: Loop, observer: LoopObserver, test: int) -> arb_mat:
    """Return W S: columns of what noise, and disturbances since the last test, add to n at a test."""
    W, T = loop.weight, arb(observer.period)
    found = (
        [W * observer.gains[min(test, len(observer.gains) - 1)] * loop.noise] if loop.noise.ncols() else []
    )
    pushes = range(len(loop.sizes) - observer.unfelt)
    if test and len(pushes):
        D = arb_mat(
            loop.n, len(pushes), [loop.sizes[k] * loop.pushes[i, k] for i in range(loop.n) for k in pushes]
        )
        cells = int(min(1 + _CELLS * float(frobenius(T * loop.A)), _MOST_CELLS))
        for cell in range(cells):
            during = ((cell * T / cells + upto(T / cells)) * loop.A).exp()
            found.append(T / cells * (W * observer.correction(test) * during * D))
    whole = arb_mat(loop.n, 0)
    for block in found:
        whole = beside(whole, block)
    return whole


def _early(sums: Sequence[Sequence[arb]], growth: arb) -> list[arb]:
    """Return by how much sums exceed the last ones, times e^{rt}."""
    most, power = [arb(0)] * len(sums[-1]), arb(1)
    for at_test in sums:
        beyond = (power * (each - last) for each, last in zip(at_test, sums[-1], strict=True))
        most = [a.max(arb(b.upper())) for a, b in zip(most, beyond, strict=True)]
        power *= growth
    return most


def _most(sums: Sequence[Sequence[arb]]) -> list[arb]:
    """Return the largest sum of each entry."""
    return [reduce(arb.max, entries) for entries in zip(*sums, strict=True)]


def _sums_by_test(factors: Sequence[arb_mat], sources: Sequence[arb_mat]) -> list[list[arb]]:
    """Return bounds of Σ_j |F_k ⋯ F_{j+1} S_j| at k = 0, 1, …, by entries; the last ones are for all later k.

    The exact factors are those of k = 1, 2, …, the sources those of j = 0, 1, …; the last ones stay. Beyond
    some k, all but the last terms are a small share of an earlier sum, see :func:`_length`.
    """
    n, last = factors[0].nrows(), factors[-1]
    length = _length(last)
    columns = max(S.ncols() for S in sources)
    if len(factors) * (len(factors) + length) * n * columns > _MOST_ENTRIES:
        raise RejectedError("observer: its gains change for too long")
    after, terms = sources[0], [sources[0]]
    found = [_sums(terms, n)]
    for k, factor in enumerate(factors, 1):
        after = sources[min(k, len(sources) - 1)]
        terms = [*(factor * term for term in terms), after]
        found.append(_sums(terms, n))
    total = [arb(0)] * n
    for _ in range(length):
        terms = [last * term for term in terms]
        total = [a + b for a, b in zip(total, _sums([after], n), strict=True)]
        after = last * after
        found.append([a + b for a, b in zip(_sums(terms, n), total, strict=True)])
    beyond = _SMALL / (1 - arb(_SMALL)) * frobenius(_column(_most(found)))
    return [*found, [arb((each + beyond).abs_upper()) for each in total]]


def _sums(blocks: Sequence[arb_mat], n: int) -> list[arb]:
    """Return the sums of |entries| of each of n rows, of all blocks."""
    sums = [arb(0)] * n
    for block in blocks:
        for i, row in enumerate(block.tolist()):
            sums[i] = sum(map(abs, row), sums[i])
    return [arb(each.abs_upper()) for each in sums]


def _from_start(
    loop: Loop, error: _Error, T: arb, growth: arb, smooth: Smooth | None
) -> tuple[list[arb], arb]:
    """Return bounds of e^{rt} |W (n̂ − Ss)| by entries and of e^{rt} ‖W n̂‖, of what follows from the start.

    ``growth`` is that of e^{rt} between two tests.
    """
    n, vectors, images = loop.n, [error.first], [identity(loop.n)]
    later = [growth * error.factors[-1]]
    if smooth is not None:
        later.append(growth * (T * smooth.rates).exp())
        vectors.append(beside(smooth.start, arb_mat(smooth.start.nrows(), n)))
        images.append(-1 * loop.weight * smooth.columns)
    rest, sizes = [arb(0)] * n, [arb(0)] * len(later)
    for k in range(len(error.factors) + max(_length(step) for step in later)):
        parts = [image * vector for image, vector in zip(images, vectors, strict=True)]
        difference = _sums([sum(parts[1:], parts[0])], n)
        rest = [most.max(each) for most, each in zip(rest, difference, strict=True)]
        sizes = [
            most.max(frobenius(image) * frobenius(vector) if number else _size(vector))
            for number, (most, image, vector) in enumerate(zip(sizes, images, vectors, strict=True))
        ]
        steps = [growth * error.factors[min(k, len(error.factors) - 1)], *later[1:]]
        vectors = [step * vector for step, vector in zip(steps, vectors, strict=True)]
    beyond = _SMALL * sum(sizes, arb(0))
    return [most.max(beyond) for most in rest], sizes[0]


def _size(vector: arb_mat) -> arb:
    """Return a bound of the norm of the first column, and of any of the others times numbers up to 1."""
    return frobenius(_column(_sums([vector], vector.nrows())))


def _radius(M: arb_mat, i: int) -> arb:
    """Return the sum of the radii of a row."""
    return sum((M[i, j].rad() for j in range(M.ncols())), arb(0))


def _largest_radius(blocks: Sequence[arb_mat], i: int) -> arb:
    """Return the largest of such sums, of blocks."""
    return reduce(arb.max, (_radius(M, i) for M in blocks))


def _column(entries: Sequence[arb]) -> arb_mat:
    return arb_mat(len(entries), 1, [*entries])


def _diagonal(entries: Sequence[arb]) -> arb_mat:
    n = len(entries)
    return arb_mat(n, n, [entries[i] if i == j else arb(0) for i in range(n) for j in range(n)])


def _length(G: arb_mat) -> int:
    """Return a k with ‖G^k‖ ≤ _SMALL: then ‖G^{k+i} v‖ ≤ _SMALL · max ‖G^j v‖ over j < k, for all i ≥ 0."""
    power = identity(G.nrows())
    for k in range(1, _MOST_POWERS):
        power = power * G
        if frobenius(power) <= _SMALL:
            return k
        if not power[0, 0].is_finite():
            break
    raise RejectedError("observer: its error is not proven to decay as fast as the bounds")
