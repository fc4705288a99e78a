"""What the sensor takes for the state at a test: x + n, with n = Ss + Σ column p, |p| ≤ f₁ = e^{−rt} or ≤ 1.

Without an observer n is the noise of a measurement. The error of an observer's estimate does not depend on
the rest of the loop, if the plant has the matrices that the observer uses:

    n_{k+1} = (I − LC) (e^{AT} n_k − ∫₀ᵀ e^{As} D d ds) + L v_{k+1},   n_0 = (I − L₀C) (x̂ − x)(0) + L₀ v_0.

L₀ is L, or v = 0. What follows from the start is F^k (I − L₀C) (x̂ − x)(0), F = (I − LC) e^{AT}. Ss with
ṡ = Λs is near it at the tests, if a witness names suitable S, Λ and s(0); the difference decays as f₁. What
follows from noise v and disturbances d has a constant bound, the sum of all |F^j S|. Both are found from
powers up to one that is small, in coordinates of W n.
"""

from flint import arb, arb_mat

from noack_check.balls import columns_of, frobenius, identity, upto
from noack_check.check import RejectedError
from noack_check.loop import Loop, Noise, Observer, Smooth

_MOST_POWERS, _SMALL = 20_000, 1e-6
_CELLS = 4
"""Parts of the time between two measurements."""
_LITTLE = 0.01
"""A decaying bound below such a share of the constant one is added to it."""


def noise_of(loop: Loop, rate: arb, smooth: Smooth | None = None) -> Noise:
    """Return bounds of n; without ``smooth`` s = 0.

    Raises:
        RejectedError: the error of the observer is not proven to decay as fast as f₁.
    """
    if loop.observer is None:
        return loop.plain_noise
    rest, size = _from_start(loop, loop.observer, rate, smooth)
    constant = _from_sources(loop, loop.observer)
    sizes = size, frobenius(arb_mat(loop.n, 1, constant))
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
    smooth = smooth or loop.plain_noise.smooth
    return Noise(arb_mat(loop.n, len(columns), entries), len(chosen[0]), smooth, sizes)


def _first_error(observer: Observer) -> arb_mat:
    return observer.first_correction * observer.start


def _step(loop: Loop, observer: Observer, M: arb_mat) -> arb_mat:
    """Return W M e^{AT} W⁻¹ of the plant."""
    return loop.weight * M * (arb(observer.period) * loop.A).exp() * loop.weight.inv()


def _from_start(loop: Loop, observer: Observer, rate: arb, smooth: Smooth | None) -> tuple[list[arb], arb]:
    """Return bounds of e^{rt} |W (n − Ss)| by entries and of e^{rt} ‖W n‖, of what follows from the start."""
    T = arb(observer.period)
    steps, vectors = [_step(loop, observer, observer.correction)], [loop.weight * _first_error(observer)]
    images = [identity(loop.n)]
    if smooth is not None:
        steps.append((T * smooth.rates).exp())
        vectors.append(smooth.start)
        images.append(-1 * loop.weight * smooth.columns)
    steps = [(rate * T).exp() * step for step in steps]
    rest, sizes = [arb(0)] * loop.n, [arb(0)] * len(steps)
    for _ in range(max(_length(step) for step in steps)):
        parts = [image * vector for image, vector in zip(images, vectors, strict=True)]
        difference = sum(parts[1:], parts[0]).entries()
        rest = [most.max(arb(entry.abs_upper())) for most, entry in zip(rest, difference, strict=True)]
        sizes = [
            most.max(frobenius(image) * frobenius(vector) if number else frobenius(vector))
            for number, (most, image, vector) in enumerate(zip(sizes, images, vectors, strict=True))
        ]
        vectors = [step * vector for step, vector in zip(steps, vectors, strict=True)]
    beyond = _SMALL * sum(sizes, arb(0))
    return [most.max(beyond) for most in rest], sizes[0]


def _from_sources(loop: Loop, observer: Observer) -> list[arb]:
    """Return bounds of |W n| by entries, of what follows from noise and disturbances."""
    W, T, F = loop.weight, arb(observer.period), _step(loop, observer, observer.correction)
    sources = [W * columns_of(loop.noise, [i]) for i in range(loop.noise.ncols())]
    for i, size in enumerate(loop.sizes[: len(loop.sizes) - observer.unfelt]):
        push = size * columns_of(loop.pushes, [i])
        for cell in range(_CELLS):
            during = ((cell * T / _CELLS + upto(T / _CELLS)) * loop.A).exp()
            sources.append(T / _CELLS * (W * observer.correction * during * push))
    sums, norms = [arb(0)] * loop.n, arb(0)
    for _ in range(_length(F)):
        for source in sources:
            sums = [total + entry.abs_upper() for total, entry in zip(sums, source.entries(), strict=True)]
            norms += frobenius(source)
        sources = [F * source for source in sources]
    beyond = _SMALL / (1 - arb(_SMALL)) * norms
    return [arb((total + beyond).abs_upper()) for total in sums]


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
