"""A document of a loop for bounds by gains, read strictly: matrices, the threshold, times and noise bounds.

Nothing here knows a network or a scenario: a loss is an event whose update never acts, and of times only
their limits are known. :mod:`.gains` says what the numbers mean, and :mod:`.words` prints them.
"""

import hashlib
from typing import NamedTuple

from flint import arb, arb_mat, fmpq, fmpq_mat

from noack_gains.balls import zeros
from noack_gains.reading import (
    MOST_TEXT,
    Matrix,
    RejectedError,
    Table,
    entries,
    exact_matrix,
    fields,
    mapping,
    names_of,
    rational,
    read_matrix,
    read_table,
    size,
    text_of,
    truth,
    whole,
)

FORMAT = "noack-gains-loop 1"
MOST_STATES, MOST_LOSSES, MOST_OUTPUTS = 40, 1000, 100
_REQUIRED = (
    "format", "name", "rate", "states", "inputs", "A", "B", "model", "gain", "weight", "start", "rule",
    "times", "losses", "disturbances", "noise", "outputs",
)  # fmt: skip
_OPTIONAL = ("about", "uncertainty", "before_input", "until", "offset", "while", "equations")


class Rule(NamedTuple):
    """The trigger's rule: with z = (x + n, e_s − n), an event needs ‖P z‖² > max(c e^{−ρt}, f)² + ‖N z‖².

    If it ``integrates``, an event needs ∫ ‖W (e_s − n)‖ dt > f since the last one, by trapezoids between
    tests.
    """

    positive: Matrix
    """P, (p, 2n)."""
    negative: Matrix
    """N, (q, 2n)."""
    level: fmpq
    """c."""
    rate: fmpq
    """ρ, 1/s."""
    floor: fmpq
    """f."""
    always: bool
    """Events may also come without the comparison, from ``times.due`` on after the last one."""
    integrates: bool


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
    lead: fmpq
    """The input that acts may have been computed for a time that is later by this."""
    start: fmpq
    """The first input acts within this time; until then the input is 0."""
    least_period: fmpq
    """Two events of a periodic rule, which compares nothing, are at least this far apart."""
    period: fmpq
    """They are at most this far apart; 0 for other rules."""
    dwell: fmpq
    """If it is not 0, the first test that counts after an event comes exactly this time after it."""
    longest: fmpq
    """Two events of a rule that compares are at most this far apart, as with a deadline; 0: not known."""
    due: fmpq
    """An event that comes without its comparison comes at least this time after the last one."""

    @property
    def from_tick(self) -> fmpq:
        """The largest difference between the time and the time for which the acting input was computed."""
        return max(self.age, self.lead)

    @property
    def least_apart(self) -> fmpq:
        """Two events are at least this far apart, whatever is measured."""
        return self.least_period if self.period > 0 else max(self.least_sampling, self.dwell)


class Output(NamedTuple):
    """What is bounded: C x, an entry of the input, or an error in the norm of W."""

    name: str
    unit: str
    rows: Matrix | None
    """C."""
    input: int | None
    error: str | None
    """"sensor" for e_s = x_s − x, "controller" for e_c = x_c − x."""


class Limit(NamedTuple):
    """The document describes the loop until |output| reaches ``less``."""

    output: str
    less: fmpq


class Loop(NamedTuple):
    """The numbers of a document, as balls where the argument computes with them."""

    A: arb_mat
    B: arb_mat
    half_A: arb_mat
    half_B: arb_mat
    H: arb_mat
    """What the models integrate; 0 if they hold the last update."""
    gain: arb_mat
    weight: arb_mat
    start: arb_mat
    rule: Rule
    times: Times
    pushes: arb_mat
    """Columns D of disturbances, (n, k)."""
    sizes: tuple[arb, ...]
    """|d_i| ≤ sizes[i]."""
    before_input: arb_mat | None
    """What is added to ẋ while no input acts, (n, 1); None: 0."""
    losses: int
    noise: tuple[arb, arb]
    """‖W n‖ ≤ n₁ f₁ + n₂ at each test, where the sensor takes x + n for x."""
    rate: fmpq
    """r in f₁ = e^{−rt}, 1/s."""
    boxed: tuple[int, ...]
    """States whose rows of A or B are known to within half-widths."""
    mismatched: tuple[int, ...]
    """Rows of A + BK − H that are not exactly 0."""
    compares_error: bool
    """The rule compares ‖W (e_s − n)‖ with its threshold plus ‖N(x + n)‖²."""

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.A.nrows())

    @property
    def needs_constant(self) -> bool:
        """Whether something is of the unit f₂ = 1."""
        return bool(self.rule.floor > 0) or bool(self.sizes) or bool(self.noise[1] > 0)

    @property
    def has_decaying_unit(self) -> bool:
        """Whether f₁ is a unit; with r = 0 it equals f₂, and one of both is enough."""
        return not (self.rate == 0 and self.needs_constant)


class Document:
    """A document that is well-formed.

    Args:
        text: the content of its file.

    Raises:
        RejectedError: it breaks a rule of the format; the message names the place.
    """

    def __init__(self, text: str) -> None:
        table = read_table(text, FORMAT, "document")
        fields(table, "document", _REQUIRED, _OPTIONAL)
        self.digest = hashlib.sha256(text.encode()).hexdigest()
        (self.name,) = names_of([table["name"]], "name")
        self.about = text_of(table.get("about", ""), "about", MOST_TEXT)
        self.states, self.state_units = self._read_states(table["states"])
        inputs = table["inputs"]
        if not isinstance(inputs, list) or not 0 < len(inputs) <= MOST_STATES:
            raise RejectedError(f"inputs: not from 1 to {MOST_STATES} names")
        self.inputs = names_of(inputs, "inputs")
        self.n, self.m = len(self.states), len(self.inputs)
        self.until = None if table.get("until") is None else size(table["until"], "until")
        self.offset = size(table.get("offset", fmpq(0)), "offset")
        self.A, self.B = (self._matrix(table, key, self.n, k) for key, k in (("A", self.n), ("B", self.m)))
        self.half_A, self.half_B = self._read_uncertainty(table)
        self.gain = exact_matrix(table["gain"], "gain", self.m, self.n)
        self.weight = exact_matrix(table["weight"], "weight", self.n, self.n)
        self.start = self._matrix(table, "start", self.n, 1)
        self.before_input = (
            None if table.get("before_input") is None else self._matrix(table, "before_input", self.n, 1)
        )
        self.model = self._read_model(table["model"])
        self.times = self._read_times(table["times"])
        self.rule = self._read_rule(table["rule"])
        self.losses = whole(table["losses"], "losses", MOST_LOSSES)
        self.disturbances = [
            self._read_disturbance(each) for each in entries(table["disturbances"], "disturbances")
        ]
        if len(self.disturbances) > 4 * MOST_STATES:
            raise RejectedError("disturbances: too many")
        self.noise = self._read_noise(table["noise"])
        self.rate = size(table["rate"], "rate")
        if self.rule.level > 0 and self.rate > self.rule.rate:
            raise RejectedError("rate: it is larger than the rate of the threshold")
        self.outputs = self._read_outputs(table["outputs"])
        self.limits = [self._read_limit(each) for each in entries(table.get("while", []), "while")]
        self.equations = self._read_equations(table.get("equations"))
        """The SHA-256 of a plant's equations of which another program verifies that they do no more."""
        self._require_times()

    def _read_equations(self, value: object) -> str | None:
        if value is None:
            return None
        fields(entry := mapping(value, "equations"), "equations", ("sha256",))
        return text_of(entry["sha256"], "equations")

    def _matrix(self, table: Table, key: str, height: int, width: int) -> Matrix:
        return read_matrix(table[key], key, height, width)

    def _read_states(self, value: object) -> tuple[list[str], list[str]]:
        states = entries(value, "states")
        if not 0 < len(states) <= MOST_STATES:
            raise RejectedError(f"states: not from 1 to {MOST_STATES}")
        for state in states:
            fields(state, "states", ("name", "unit"))
        return names_of([s["name"] for s in states], "states"), [text_of(s["unit"], "states") for s in states]

    def _read_uncertainty(self, table: Table) -> tuple[Matrix, Matrix]:
        """Return the half-widths of A and B, which are 0 without the key."""
        if table.get("uncertainty") is None:
            return Matrix(fmpq_mat(self.n, self.n)), Matrix(fmpq_mat(self.n, self.m))
        entry = mapping(table["uncertainty"], "uncertainty")
        fields(entry, "uncertainty", ("A", "B"))
        found = [
            exact_matrix(entry[key], f"uncertainty of {key}", self.n, width)
            for key, width in (("A", self.n), ("B", self.m))
        ]
        if any(half < 0 for M in found for half in M.mid.entries()):
            raise RejectedError("uncertainty: below 0")
        return found[0], found[1]

    def _read_model(self, value: object) -> tuple[Matrix, Matrix] | None:
        """Return A and B of the models; None: they hold the last update."""
        if value is None:
            return None
        entry = mapping(value, "model")
        fields(entry, "model", ("A", "B"))
        return (
            exact_matrix(entry["A"], "A of the model", self.n, self.n),
            exact_matrix(entry["B"], "B of the model", self.n, self.m),
        )

    def _read_times(self, value: object) -> Times:
        table = mapping(value, "times")
        fields(table, "times", Times._fields)
        return Times(*(size(table[name], f"times: {name}") for name in Times._fields))

    def _read_rule(self, value: object) -> Rule:
        table = mapping(value, "rule")
        fields(table, "rule", ("compared", "share", "level", "rate", "floor", "always", "integrates"))
        P, N = (read_matrix(table[key], f"rule: {key}", None, 2 * self.n) for key in ("compared", "share"))
        level, rate, floor = (size(table[key], f"rule: {key}") for key in ("level", "rate", "floor"))
        always, integrates = (truth(table[key], f"rule: {key}") for key in ("always", "integrates"))
        return Rule(P, N, level, rate, floor, always, integrates)

    def _read_disturbance(self, entry: Table) -> tuple[Matrix, fmpq]:
        """Return the column of a disturbance, and its largest size."""
        fields(entry, "disturbances", ("column", "size"))
        column = read_matrix(entry["column"], "disturbances", self.n, 1)
        return column, size(entry["size"], "disturbances")

    def _read_noise(self, value: object) -> tuple[fmpq, fmpq]:
        table = mapping(value, "noise")
        fields(table, "noise", ("decaying", "constant"))
        return size(table["decaying"], "noise"), size(table["constant"], "noise")

    def _read_outputs(self, value: object) -> list[Output]:
        found = [self._read_output(entry) for entry in entries(value, "outputs")]
        names_of([output.name for output in found], "outputs")
        if not 0 < len(found) <= MOST_OUTPUTS:
            raise RejectedError(f"outputs: not from 1 to {MOST_OUTPUTS}")
        is_moved = self.until is not None or self.before_input is not None
        if is_moved and any(output.input is not None for output in found):
            raise RejectedError("outputs: about a reference, or where the loop rests, the input is none")
        return found

    def _read_output(self, entry: Table) -> Output:
        kinds = {"rows", "input", "error"} & {*entry}
        if len(kinds) != 1:
            raise RejectedError("outputs: one of rows, input and error is needed")
        fields(entry, "outputs", ("name", "unit", *kinds))
        name, unit = text_of(entry["name"], "outputs"), text_of(entry["unit"], "outputs")
        if "rows" in entry:
            rows = read_matrix(entry["rows"], "outputs", None, self.n)
            if not rows.shape[0]:
                raise RejectedError("outputs: no row")
            return Output(name, unit, rows, None, None)
        if "input" in entry:
            return Output(name, unit, None, whole(entry["input"], "outputs: input", self.m - 1), None)
        if entry["error"] not in ("sensor", "controller"):
            raise RejectedError("outputs: error: neither sensor nor controller")
        return Output(name, unit, None, None, str(entry["error"]))

    def _read_limit(self, entry: Table) -> Limit:
        """Read a limit, of an entry of x or of the input."""
        fields(entry, "while", ("output", "less"))
        chosen = [output for output in self.outputs if output.name == entry["output"]]
        less = rational(entry["less"], "while")
        if not chosen or chosen[0].error is not None or less <= 0:
            raise RejectedError("while: no such output of x or of the input, or a limit that is not above 0")
        return Limit(chosen[0].name, less)

    def _require_times(self) -> None:
        """Require the times to have a meaning together with the rule."""
        times, rule, compares = self.times, self.rule, self.rule.positive.shape[0] > 0
        if times.least_sampling > times.sampling:
            raise RejectedError("times: tests further apart than they may be")
        if times.period > 0 and (compares or rule.integrates):
            raise RejectedError("rule: compares and is periodic")
        if not times.period > 0 and not compares:
            raise RejectedError("rule: compares nothing, and has no largest time between events")
        if times.least_period > times.period or (times.period > 0 and not times.least_period > 0):
            raise RejectedError("times: events of a periodic rule further apart than they may be, or at once")
        if times.period > 0 and times.least_period < times.least_sampling:
            raise RejectedError("times: events between tests")
        if times.longest > 0 and not rule.always:
            raise RejectedError("times: events are due, and the rule needs its comparison")
        has_more = rule.level != 0 or rule.negative.shape[0] or times.dwell > 0 or rule.always
        if rule.integrates and (has_more or not self.compares_error):
            raise RejectedError("rule: integrates, and has more than ‖W (e_s − n)‖ and a floor")
        if times.dwell > 0 and (times.dwell < times.sampling or times.period > 0):
            raise RejectedError("times: a dwell time that ends before the next test, or of a periodic rule")
        if times.sampling == 0 and any(
            M is not None and M[i, j] != 0
            for M in rule.positive
            for i in range(rule.positive.shape[0])
            for j in range(self.n)
        ):
            raise RejectedError("rule: tested at all times, it may hold at once after an event")

    @property
    def compares_error(self) -> bool:
        """Whether the rule is ‖W (e_s − n)‖² > threshold² + ‖N(x + n)‖², exactly."""
        P, N, n = self.rule.positive, self.rule.negative, self.n
        if P.radius is not None or P.shape[0] != n:
            return False
        expected = [
            [self.weight.mid[i, j - n] if j >= n else fmpq(0) for j in range(2 * n)] for i in range(n)
        ]
        errors = (M[i, j] for M in N if M is not None for i in range(N.shape[0]) for j in range(n, 2 * n))
        return P.mid == fmpq_mat(expected) and all(entry == 0 for entry in errors)

    @property
    def H(self) -> Matrix:
        """What the models integrate, exactly: A + BK of the models, or 0."""
        if self.model is None:
            return Matrix(fmpq_mat(self.n, self.n))
        A, B = self.model
        return Matrix(A.mid + B.mid * self.gain.mid)

    @property
    def loop(self) -> Loop:
        """The numbers of the loop."""
        H = self.H
        radius = self.A.radius
        if self.B.radius is not None:
            sizes = fmpq_mat(self.m, self.n, [abs(entry) for entry in self.gain.mid.entries()])
            radius = self.B.radius * sizes if radius is None else radius + self.B.radius * sizes
        mismatch = Matrix(self.A.mid + self.B.mid * self.gain.mid - H.mid, radius)
        halves = [*zip(self.half_A.zero_rows(), self.half_B.zero_rows(), strict=True)]
        pushes = zeros(self.n, len(self.disturbances))
        for k, (column, _) in enumerate(self.disturbances):
            for i, entry in enumerate(column.balls.entries()):
                pushes[i, k] = entry
        return Loop(
            A=self.A.balls,
            B=self.B.balls,
            half_A=self.half_A.balls,
            half_B=self.half_B.balls,
            H=H.balls,
            gain=self.gain.balls,
            weight=self.weight.balls,
            start=self.start.balls,
            rule=self.rule,
            times=self.times,
            pushes=pushes,
            sizes=tuple(arb(most) for _, most in self.disturbances),
            before_input=None if self.before_input is None else self.before_input.balls,
            losses=self.losses,
            noise=(arb(self.noise[0]), arb(self.noise[1])),
            rate=self.rate,
            boxed=tuple(i for i, pair in enumerate(halves) if not all(pair)),
            mismatched=tuple(i for i, is_zero in enumerate(mismatch.zero_rows()) if not is_zero),
            compares_error=self.compares_error,
        )

    def output(self, name: str) -> Output:
        """Return an output by its name."""
        return next(output for output in self.outputs if output.name == name)
