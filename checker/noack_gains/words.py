"""A document in words: what the bounds are proven of. Numbers are rounded to four digits here only."""

from collections.abc import Iterator, Sequence

from flint import arb, fmpq

from noack_gains.document import Document, Output
from noack_gains.reading import Matrix

_DIGITS = 4


def in_words(document: Document) -> list[str]:
    """Return the lines of a document."""
    return [*_lines(document)]


def conditions(document: Document) -> list[str]:
    """Return what a bound is proven under, apart from the matrices: the lines that a sentence prints."""
    return [*_events(document), *_times(document), *_noise(document), *_runs(document)]


def _lines(d: Document) -> Iterator[str]:
    yield f"# Loop for bounds by gains: {d.name}"
    if d.about:
        yield d.about
    pairs = zip(d.states, d.state_units, strict=True)
    yield f"x = {', '.join(f'{name} [{unit}]' if unit else name for name, unit in pairs)}"
    yield from _rows("d/dt", d.states, [(d.A, d.states), (d.B, [f"u {name}" for name in d.inputs])])
    for name, M in (("A", d.half_A), ("B", d.half_B)):
        if not M.is_zero:
            yield f"  entries of {name} are unknown to within {_matrix(M)}, and may change at any time"
    for column, most in d.disturbances:
        yield f"  plus an unknown signal of at most {_number(most)} times {_matrix(column)}"
    yield from _rows("u =", d.inputs, [(d.gain, [f"x_c {name}" for name in d.states])])
    if d.model is None:
        yield "the models x_s and x_c hold the last update"
    else:
        yield from _rows(
            "d/dt", [f"x_s {name}" for name in d.states], [(d.H, [f"x_s {n}" for n in d.states])]
        )
        yield "the controller's model x_c moves as x_s does"
    yield from conditions(d)
    yield f"starts at x = {_matrix(d.start)}, where x_s = x + n"
    if d.before_input is not None:
        yield f"while no input acts, {_matrix(d.before_input)} is added to dx/dt"
    for output in d.outputs:
        yield f"output {output.name}{f' [{output.unit}]' if output.unit else ''} = {_output(output, d)}"
    for limit in d.limits:
        yield f"the document ends when |{limit.output}| reaches {_number(limit.less)}"


def _events(d: Document) -> Iterator[str]:
    rule = d.rule
    names = [*(f"{state} + n" for state in d.states), *(f"e {state}" for state in d.states)]
    threshold = " or ".join(
        text
        for size, text in (
            (rule.level, f"{_number(rule.level)} e^(−{_number(rule.rate)} t)"),
            (rule.floor, _number(rule.floor)),
        )
        if size > 0
    )
    threshold = f"the larger of {threshold}" if " or " in threshold else threshold or "0"
    if d.times.period > 0:
        yield "an event depends on the time alone"
    elif rule.integrates:
        yield f"an event needs an integral of ‖W e‖ since the last one that is above {threshold} s"
    else:
        yield f"an event needs ‖({_combined(rule.positive, names)})‖ above {threshold}"
        if rule.negative.shape[0]:
            yield f"  more exactly above the root of its square plus ‖({_combined(rule.negative, names)})‖²"
    if rule.always:
        yield f"an event may also come without it, {_ms(d.times.due)} after the last one or later"
    yield f"an event sends an update; at most {d.losses} updates in a row are lost"
    yield f"at an event x_s becomes x + n, and else e is x_s − (x + n); W = {_matrix(d.weight)}"


def _times(d: Document) -> Iterator[str]:
    t = d.times
    if t.sampling > 0:
        yield f"tests are {_ms(t.least_sampling)} to {_ms(t.sampling)} apart"
    else:
        yield "the trigger is tested at all times"
    if t.period > 0:
        yield f"events are {_ms(t.least_period)} to {_ms(t.period)} apart"
    if t.dwell > 0:
        yield f"no test counts within {_ms(t.dwell)} after an event"
    if t.longest > 0:
        yield f"events are at most {_ms(t.longest)} apart"
    yield f"an update that is not lost acts within {_ms(t.delay)}; the first input within {_ms(t.start)}"
    yield f"the input that acts is for a time up to {_ms(t.age)} ago, or up to {_ms(t.lead)} ahead"
    if d.until is not None:
        yield f"all this is so up to t = {_number(d.until)} s"
    if d.offset > 0:
        yield f"the outputs are computed from a state that differs from x by at most {_number(d.offset)}"


def _noise(d: Document) -> Iterator[str]:
    decaying, constant = d.noise
    if decaying > 0 or constant > 0:
        parts = [f"{_number(decaying)} e^(−{_number(d.rate)} t)"] if decaying > 0 else []
        parts += [_number(constant)] if constant > 0 else []
        yield f"at a test the sensor takes x + n for x, with ‖W n‖ ≤ {' + '.join(parts)}"


def _runs(d: Document) -> Iterator[str]:
    """Yield what a run has to be where nothing may keep two events apart.

    With tests at all times a threshold does if it is above 0, and above what the noises of two measurements
    add up to: only the rest has to be reached by a flow. An integral begins at 0.
    """
    rule, noise = d.rule, 2 * (d.noise[0] + d.noise[1])
    if d.times.least_apart > 0:
        return
    if noise == 0 or rule.integrates:
        is_kept = rule.level > 0 or rule.floor > 0
    else:
        is_kept = rule.floor > noise or (rule.rate == 0 and rule.level > noise)
    if not is_kept:
        yield "all this is about runs with finitely many events in finite time"


def _output(output: Output, d: Document) -> str:
    if output.rows is not None:
        return _combined(output.rows, d.states)
    if output.input is not None:
        return f"u {d.inputs[output.input]}"
    return "W (x_s − x)" if output.error == "sensor" else "W (x_c − x)"


def _rows(begin: str, names: Sequence[str], blocks: Sequence[tuple[Matrix, Sequence[str]]]) -> Iterator[str]:
    for i, name in enumerate(names):
        terms = [
            _term(M.mid[i, j], of)
            for M, columns in blocks
            for j, of in enumerate(columns)
            if M.mid[i, j] != 0
        ]
        equals = name if begin.endswith("=") else f"{begin} {name} ="
        text = f"u {equals} =" if begin.endswith("=") else equals
        yield f"{text} {_joined(terms)}"


def _combined(M: Matrix, names: Sequence[str]) -> str:
    height, width = M.shape
    rows = [
        _joined([_term(M.mid[i, j], names[j]) for j in range(width) if M.mid[i, j] != 0])
        for i in range(height)
    ]
    return "; ".join(rows)


def _term(value: fmpq, name: str) -> str:
    sign = "− " if value < 0 else "+ "
    return f"{sign}{'' if abs(value) == 1 else f'{_number(abs(value))} '}{name}"


def _joined(terms: Sequence[str]) -> str:
    return " ".join(terms).removeprefix("+ ") or "0"


def _matrix(M: Matrix) -> str:
    height, width = M.shape
    rows = [", ".join(_number(M.mid[i, j]) for j in range(width)) for i in range(height)]
    return f"[{'; '.join(rows)}]"


def _number(value: fmpq) -> str:
    return f"{float(arb(value).mid()):.{_DIGITS}g}".replace("-", "−")


def _ms(value: fmpq) -> str:
    return "0" if value == 0 else f"{_number(1000 * value)} ms"
