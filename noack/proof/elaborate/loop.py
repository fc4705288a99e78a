"""What a statement about a loop depends on, as numbers: plant, model, gain, trigger's rule, times, losses."""

from typing import NamedTuple

from flint import arb, arb_mat, fmpq

from noack.core.balls import (
    columns_of,
    frobenius,
    identity,
    is_positive,
    is_zero,
    rows_of,
    stack,
    transpose,
    zeros,
)
from noack_equations import Along, Region

__all__ = [
    "Along",
    "Loop",
    "LoopObserver",
    "Memory",
    "Noise",
    "Region",
    "Rule",
    "Smooth",
    "Times",
    "no_smooth",
]

_MOST_STATES, _MOST_LOSSES = 40, 1000
"""A proof of a larger loop would take hours."""


class Memory(NamedTuple):
    """A number η that a rule keeps between tests, whose positive part the rule's right side has in addition.

    From one test to the next one, T later, η becomes e^{−λT} η + (1 − e^{−λT})/λ · zᵀΨz with z = (x, e_s) at
    the first of both: after the event if it is one, so that e_s is 0.
    """

    decay: arb  # λ, 1/s
    gain: arb_mat  # Ψ, symmetric, as many rows as z has
    start: arb  # η at t = 0, before z of this time counts

    def starts_positive(self, n: int) -> bool:
        """Return whether η ≥ 0 at the first test: e_s is 0 at t = 0."""
        return is_positive(rows_of(columns_of(self.gain, range(n)), range(n)))


class Rule(NamedTuple):
    """The trigger's rule: with z = (x, e_s), an event needs ‖P z‖² > max(c e^{−ρt}, f)² + ‖N z‖² + η⁺.

    If it is ``of_input``, z is (x, K e_s), also for Ψ, with n + m entries.

    ``always`` says that events may also come without the comparison, as after a deadline.

    If it ``integrates``, an event needs ∫ ‖P z‖ dt > f since the last one, by trapezoids between tests.
    """

    positive: arb_mat  # P, (p, 2n)
    negative: arb_mat  # N, (q, 2n)
    level: arb  # c
    rate: arb  # ρ, 1/s
    floor: arb  # f
    always: bool = False
    memory: Memory | None = None  # of η; None: η = 0
    of_input: bool = False
    integrates: bool = False


class Times(NamedTuple):
    """The times of a loop, in s, exactly. All are 0 under ideal conditions."""

    sampling: fmpq
    """The rule is tested at least this often."""
    least_sampling: fmpq
    """Two tests are at least this far apart."""
    delay: fmpq
    """The first input that is computed from an update acts within this time after its event, if at all."""
    age: fmpq
    """The input that acts at t is K e^{−Hs} x_c(t) for an s from −:attr:`lead` to this."""
    start: fmpq
    """The first input acts within this time; until then the input is 0."""
    least_period: fmpq = fmpq(0)
    """Two events of a periodic rule, which compares nothing, are at least this far apart."""
    period: fmpq = fmpq(0)
    """They are at most this far apart; 0 for other rules."""
    dwell: fmpq = fmpq(0)
    """If it is not 0, the first test that counts after an event comes exactly this time after it."""
    longest: fmpq = fmpq(0)
    """Two events of a rule that compares are at most this far apart, as with a deadline; 0: not known."""
    due: fmpq = fmpq(0)
    """An event that comes without its comparison comes at least this time after the last one."""
    lead: fmpq = fmpq(0)
    """The input that acts may have been computed for a time that is later by this, as at a late step."""

    @property
    def from_tick(self) -> fmpq:
        """The largest difference between the time and the time for which the acting input was computed."""
        return max(self.age, self.lead)

    @property
    def least_apart(self) -> fmpq:
        """Two events are at least this far apart, whatever is measured."""
        return self.least_period if self.period > 0 else max(self.least_sampling, self.dwell)


class LoopObserver(NamedTuple):
    """An observer in the sensor, for a plant that has the matrices A and B that it uses.

    At each test its error becomes I − LC times that of the prediction, plus L times the noise of the test. Of
    each gain a ball is known.
    """

    gains: tuple[arb_mat, ...]  # L at the first tests, (n, p); the last one has those at all later ones
    outputs: arb_mat  # C, (p, n)
    start: arb_mat  # x̂ − x before the first test, at t = 0, (n, 1)
    period: fmpq  # T, s, exactly between two tests
    unfelt: int = 0
    """So many disturbances, the last ones, are those of a reference: it predicts them exactly, too."""

    def correction(self, test: int) -> arb_mat:
        """Return I − LC at a test, (n, n)."""
        gain = self.gains[min(test, len(self.gains) - 1)]
        return identity(gain.nrows()) - gain * self.outputs

    @property
    def last_correction(self) -> arb_mat:
        """I − LC at all tests but the first ones, (n, n)."""
        return self.correction(len(self.gains))


class Smooth(NamedTuple):
    """A part Ss of n that decays smoothly, ṡ = Λs; with no entries there is none."""

    columns: arb_mat  # S, (n, q)
    rates: arb_mat  # Λ, (q, q)
    start: arb_mat  # s(0), (q, 1)


def no_smooth(n: int) -> Smooth:
    """Return the part without entries."""
    return Smooth(zeros(n, 0), zeros(0, 0), zeros(0, 1))


class Noise(NamedTuple):
    """Bounds of n, where x + n is what the sensor takes for the state at a test: n = Ss + Σ column p."""

    columns: arb_mat  # (n, k)
    decaying: int  # of so many columns, the first ones, |p| ≤ f₁; of the others |p| ≤ f₂
    smooth: "Smooth"
    sizes: tuple[arb, arb]
    """‖W n‖ is at most their sum, times f₁ and f₂."""


class Loop(NamedTuple):
    """A loop with n states and m inputs, in coordinates in which its set-point is 0."""

    A: arb_mat  # (n, n)
    B: arb_mat  # (n, m)
    half_A: arb_mat  # the plant's entries are within ± these of A and B
    half_B: arb_mat
    model_A: arb_mat
    model_B: arb_mat
    gain: arb_mat  # K, (m, n)
    weight: arb_mat  # W of ‖·‖_W, (n, n)
    holds: bool  # the models hold the last update: H = 0
    start: arb_mat  # x(0), (n, 1)
    rule: Rule
    pushes: arb_mat  # columns D of disturbances, (n, k)
    sizes: tuple[arb, ...]  # |d_i| ≤ sizes[i]
    noise: arb_mat
    """Columns of the noise of tests, (n, k), or (p, k) of p outputs: Σ column p with |p_i| ≤ 1 for each."""
    losses: int  # most updates lost in a row
    times: Times
    observer: LoopObserver | None = None
    outputs: arb_mat = zeros(0, 0)
    """The rows of C in y = Cx, (p, n); without rows y is x."""
    along: tuple[Along, ...] = ()
    """What is known of each disturbance; (): nothing of any."""
    region: Region | None = None
    """Where the plant is one with such matrices and disturbances; None: everywhere."""
    loads: int = 0
    """The last states are so many constants, which are 0 in these coordinates: see :mod:`.scenario`."""
    push_before_input: arb_mat | None = None
    """What is added to ẋ while no input acts, (n, 1), of which a ball has all values; None: 0."""
    until: fmpq | None = None
    """Up to this time, in s, the loop is one with such disturbances; None: at all times."""
    offset: arb = arb(0)
    """x is at most this far from what statements are about: see :mod:`.reference`."""

    @property
    def output_rows(self) -> arb_mat:
        """C, (p, n)."""
        return self.outputs if self.outputs.nrows() else identity(self.n)

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.nrows())

    @property
    def measured(self) -> int:
        """Number of entries of a measurement."""
        return self.n if self.observer is None else int(self.observer.outputs.nrows())

    @property
    def plain_noise(self) -> Noise:
        """Bounds of n without an observer."""
        n, rows = self.n, (self.weight * self.noise).tolist() if self.noise.ncols() else []
        size = frobenius(arb_mat(1, len(rows), [sum((abs(entry) for entry in row), arb(0)) for row in rows]))
        return Noise(self.noise, 0, no_smooth(n), (arb(0), size))

    @property
    def needs_constant(self) -> bool:
        """Whether f₂ is a state."""
        is_needless = self.rule.floor == 0 and not self.sizes and not self.noise.ncols()
        return not is_needless  # also for a ball around 0

    def has_decaying_unit(self, rate: arb) -> bool:
        """Return whether f₁ is a state; with r = 0 it equals f₂, and one of both is enough."""
        return not (rate == 0 and self.needs_constant)

    @property
    def needs_tests_apart(self) -> bool:
        """Whether only a model covers the rule in which tests are an exact time apart."""
        return self.rule.memory is not None or self.times.dwell > 0

    @property
    def seen(self) -> arb_mat | None:
        """G, (q, n), if nothing depends on errors but through G e, where the models hold the last update.

        None: it may depend on all entries.
        """
        n, m, rule, memory = self.n, self.gain.nrows(), self.rule, self.rule.memory
        if not self.holds:
            return None
        if rule.of_input:
            return self.gain if m < n and (self.gain * transpose(self.gain)).det() > 0 else None
        columns = [rule.positive, rule.negative, *([] if memory is None else [memory.gain])]
        parts = [self.gain, *(columns_of(M, range(n, 2 * n)) for M in columns)]
        seen = [i for i in range(n) if not all(is_zero(columns_of(M, [i])) for M in parts)]
        return rows_of(identity(n), seen) if 0 < len(seen) < n else None

    @property
    def H(self) -> arb_mat:
        """What the models integrate."""
        closed = self.model_A + self.model_B * self.gain
        return closed * 0 if self.holds else closed

    def fault(self) -> str:
        """Return what is wrong with the numbers, or an empty text."""
        n, rule, times = self.n, self.rule, self.times
        m, k = self.B.ncols(), self.pushes.ncols()
        if not 0 < max(n, m, k, self.noise.ncols()) <= _MOST_STATES or not 0 <= self.losses <= _MOST_LOSSES:
            return f"not from 1 to {_MOST_STATES} states, or not from 0 to {_MOST_LOSSES} losses"
        shapes = {
            "A": (n, n), "B": (n, m), "half_A": (n, n), "half_B": (n, m), "model_A": (n, n),
            "model_B": (n, m), "gain": (m, n), "weight": (n, n), "start": (n, 1), "pushes": (n, k),
            "noise": (self.measured, self.noise.ncols()), "outputs": (self.output_rows.nrows(), n),
        }  # fmt: skip
        matrices = {name: getattr(self, name) for name in shapes if name != "outputs"} | {
            "outputs": self.output_rows,
            "rule.positive": rule.positive, "rule.negative": rule.negative,
        }  # fmt: skip
        if self.observer is not None:
            shapes |= {"measured": (self.measured, n), "first estimate": (n, 1)}
            matrices |= {"measured": self.observer.outputs, "first estimate": self.observer.start}
            for i, gain in enumerate(self.observer.gains):
                shapes[f"gain {i}"], matrices[f"gain {i}"] = (n, self.measured), gain
        if self.push_before_input is not None:
            shapes["push"], matrices["push"] = (n, 1), self.push_before_input
        compared = n + m if rule.of_input else 2 * n
        shapes |= {name: (matrices[name].nrows(), compared) for name in ("rule.positive", "rule.negative")}
        if rule.memory is not None:
            shapes["rule.memory.gain"] = (compared, compared)
            matrices["rule.memory.gain"] = rule.memory.gain
        for name, M in matrices.items():
            if (M.nrows(), M.ncols()) != shapes[name]:
                return f"{name}: not {' x '.join(map(str, shapes[name]))}"
            if not all(entry.is_finite() for entry in M.entries()):
                return f"{name}: not finite"
        sizes = {"rule.level": rule.level, "rule.floor": rule.floor}
        sizes |= {f"sizes[{i}]": size for i, size in enumerate(self.sizes)}
        if rule.memory is not None:
            sizes |= {"rule.memory.decay": rule.memory.decay, "rule.memory.start": rule.memory.start}
        halves = (*self.half_A.entries(), *self.half_B.entries())
        sizes |= {f"half-width {i}": half for i, half in enumerate(halves)}
        for name, size in sizes.items():
            if not (size.is_finite() and size >= 0):
                return f"{name}: not a number of at least 0"
        if not (self.offset.is_finite() and self.offset >= 0):
            return "offset: not a number of at least 0"
        if not 0 <= self.loads < n:
            return "loads: not fewer than states"
        constant = range(n - self.loads, n)
        moving = [self.A, self.B, self.half_A, self.half_B, self.start, self.pushes]
        if self.push_before_input is not None:
            moving.append(self.push_before_input)
        if not all(is_zero(rows_of(M, constant)) for M in moving):
            return "loads: they may change, or are not 0 in these coordinates"
        compared_forms = [rule.positive, rule.negative, *([] if rule.memory is None else [rule.memory.gain])]
        if self.loads and not all(is_zero(columns_of(M, range(n))) for M in compared_forms if M.nrows()):
            return "loads: the rule compares x, which is not 0 where the loop rests"
        if self.observer is not None:
            is_known = is_zero(self.half_A) and is_zero(self.half_B)
            if not (is_known and self.model_A == self.A and self.model_B == self.B):
                return "observer: its model may not be the plant"
            if not 0 <= self.observer.unfelt <= k:
                return "observer: it predicts more disturbances than there are"
            if not self.observer.gains:
                return "observer: no gain"
            if not (times.sampling > 0 and self.observer.period > 0):
                return "observer: without tests at times"
        if self.along and [(a.row.nrows(), a.row.ncols()) for a in self.along] != [(1, n + m)] * k:
            return f"along: not a row of {n + m} for each disturbance"
        if n == 0 or len(self.sizes) != k:
            return "no states, or not one size for each disturbance"
        if not all(time >= 0 for time in times) or times.least_sampling > times.sampling:
            return "times: below 0, or tests further apart than they may be"
        if times.period > 0 and rule.positive.nrows():
            return "rule: compares and is periodic"
        if times.least_period > times.period or (times.period > 0 and not times.least_period > 0):
            return "times: events of a periodic rule further apart than they may be, or at once"
        if times.period > 0 and times.least_period < times.least_sampling:
            return "times: events between tests"
        if rule.of_input and not self.needs_tests_apart:
            return "rule: of the input, and tested at any times"
        if rule.memory is not None and not times.sampling == times.least_sampling > 0:
            return "rule: needs tests at times that are a known time apart"
        if times.longest > 0 and not rule.always:
            return "times: events are due, and the rule needs its comparison"
        if rule.integrates and (rule.level != 0 or rule.negative.nrows() or times.dwell > 0 or rule.always):
            return "rule: integrates, and has more than a floor"
        if times.dwell > 0 and (times.dwell < times.sampling or times.period > 0):
            return "times: a dwell time that ends before the next test, or of a periodic rule"
        if rule.memory is not None and not rule.memory.starts_positive(n):
            return "rule: a memory that may begin below 0"
        if rule.memory is not None and times.dwell > times.sampling:
            return "rule: a memory that changes during a dwell time"
        if times.sampling == 0 and not is_zero(rule.positive * stack([identity(n), zeros(n, n)])):
            return "rule: tested at all times, it may hold at once after an event"
        return ""
