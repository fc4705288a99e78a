"""A loop document as text: the page that says what a proof is about."""

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

_WIDTH = 108
_DIGITS = 4
_MS = 1000
_NARROW = 1e-9
"""Intervals that are narrower are shown as their middle."""
_CLOCKS = {
    "zero": "the clock is set to 0",
    "keeps": "the clock goes on",
    "any": "the clock then has any value that is allowed there",
}
_READING = (
    "Each location has a clock: it shows what the last edge has set it to, plus the time since; at the start "
    "it shows 0. Numbers are rounded to four digits; [a, b] is any number from a to b."
)
Table = Mapping[str, Any]


def in_words(document: Table) -> str:
    """Return the text of a loop document.

    Args:
        document: its table, as :class:`.loop_document.LoopDocument` has it or JSON reads it.

    Example:
        >>> print(in_words(json.loads(Path("pendulum.loop.json").read_text())))  # doctest: +SKIP
    """
    return "\n".join(_lines(document))


def _lines(document: Table) -> Iterator[str]:
    names = [coordinate["name"] for coordinate in document["coordinates"]]
    yield f"# Loop document: {document['name']}"
    yield ""
    yield from _wrapped("z = ", [_with_unit(c) for c in document["coordinates"]], ", ")
    if "about" in document:
        yield from _wrapped(document["about"], [], "")
    noise = [c["name"] for c in document["coordinates"] if c.get("noise")]
    if noise:
        yield from _wrapped("Noise, any value at each moment that the facts allow: ", noise, ", ")
    units = []
    if document.get("decaying"):
        rate = _number(document["decaying"]["rate"])
        units.append(f"{document['decaying']['coordinate']} = e^(−{rate} t)")
    if document.get("constant"):
        units.append(f"{document['constant']} = 1")
    yield f"Units of the bounds: {', '.join(units)}."
    yield from _wrapped(_READING, [], "")
    yield from ("", "## Facts: Σ|left|² ≤ Σ|right|²")
    used = {name for fact in document["facts"].values() for name in (*fact["less"], *fact["more"])}
    for name, fact in document["facts"].items():
        left, right = (" + ".join(f"|{each}|²" for each in fact[side]) or "0" for side in ("less", "more"))
        yield from _wrapped(f"- {name!r}: {left} ≤ {right} ({fact['words']})", [], "")
    for name in sorted(used & {*document["rows"]}, key=list(document["rows"]).index):
        shown = [_row(row, names) for row in document["rows"][name]] or ["0"]
        yield from _wrapped(f"- where {name} = ", shown, "; ")
    for name, corners in document["motions"].items():
        yield from _motion(name, corners, document)
    if document.get("steps"):
        yield from ("", "## Steps of edges that last: M in z := M z, or F in z := e^(F s) z over s seconds")
        for name, step in document["steps"].items():
            yield from _step(name, step, document)
    yield from ("", "## Locations: how z moves, for how long, and what is 0")
    for location in document["locations"]:
        yield from _location(location, document)
    yield from ("", "## Edges: which transitions may happen, when, and what they change")
    inside = {location["name"]: location["coordinates"] for location in document["locations"]}
    for edge in document["edges"]:
        yield from _edge(edge, names, inside[edge["from"]])
    yield from ("", "## Start and outputs")
    yield from _start(document["start"], names, noise)
    for output in document["outputs"]:
        yield from _output(output, names, len(document["locations"]))
    for limit in document.get("while", []):
        yield f"- the document ends when |{limit['output']}| reaches {_number(limit['less'])}"
    if "equations" in document:
        yield from _equations(document["equations"])


def _equations(claim: Table) -> Iterator[str]:
    """Yield what a document claims of a plant's equations."""
    states = claim["states"]
    inputs = [f"u{j}" for j in range(len(claim["B"][0]))]
    yield from ("", "## The plant's equations, which the motions allow: another program verifies this")
    yield f"- SHA-256 {claim['sha256']}"
    signals = [f"p{k}" for k in range(1, len(claim["signals"]) + 1)]
    for i, name in enumerate(states):
        row = [*claim["A"][i], *claim["B"][i], *(signal["column"][i][0] for signal in claim["signals"])]
        yield from _wrapped(f"- d/dt {name} = {_row(row, [*states, *inputs, *signals])}", [], "")
    halves = [
        f"that of {of} in d/dt {name} by {_number(half)}"
        for name, *rows in zip(states, claim["half_A"], claim["half_B"], strict=True)
        for of, half in zip((*states, *inputs), (*rows[0], *rows[1]), strict=True)
        if _value(half)
    ]
    if halves:
        yield from _wrapped("- coefficients vary at most: ", halves, ", ")
    for k, signal in enumerate(claim["signals"], 1):
        along = ""
        if "along" in signal:
            power = _row(signal["along"][0], [*states, *inputs])
            along = f", and p{k} · ({power}) ≥ {_number(signal['least'])} p{k}²"
        yield from _wrapped(f"- p{k} is unknown: |p{k}| ≤ 1{along}", [], "")


def _motion(name: str, corners: Sequence[Table], document: Table) -> Iterator[str]:
    mixture = f"any mixture of {len(corners)} corners, which may change at any time; corner 1:"
    yield from ("", f"## Motion {name!r}: {'exactly' if len(corners) == 1 else mixture}")
    first = dict(_corner(corners[0], document))  # an input is shown where it is an output
    for text in first.values():
        yield from _wrapped(f"- {text}", [], "")
    for number, corner in enumerate(corners[1:], 2):
        others = [text for key, text in _corner(corner, document) if text != first.get(key)]
        yield from _wrapped(f"- corner {number} as corner 1, but ", others or ["for rounding"], "; ")


def _corner(corner: Table, document: Table) -> Iterator[tuple[str, str]]:
    """Yield what moves, or is unknown, with its text."""
    names = [coordinate["name"] for coordinate in document["coordinates"]]
    still = {document["decaying"]["coordinate"] if document.get("decaying") else "", document.get("constant")}
    still |= {coordinate["name"] for coordinate in document["coordinates"] if coordinate.get("noise")}
    for i, row in enumerate(corner["matrix"]):
        signals = [unknown["column"][i][0] for unknown in corner["unknown"]]
        if names[i] not in still:
            rate = _row([*row, *signals], [*names, *(f"p{k}" for k in range(1, len(signals) + 1))])
            yield names[i], f"d/dt {names[i]} = {rate}"
    for index in sorted(
        {int(_value(output["input"])) for output in document["outputs"] if "input" in output}
    ):
        if index < len(corner["input"]):
            yield f"input {index}", f"entry {index} of the input = {_row(corner['input'][index], names)}"
    for k, unknown in enumerate(corner["unknown"], 1):
        sizes = "; ".join(_row(row, names) for row in unknown["rows"]) or "0"
        along = ""
        if "along" in unknown:
            least = _number(unknown["least"])
            along = f", and p{k} · ({_row(unknown['along'][0], names)}) ≥ {least} p{k}²"
        yield f"p{k} is unknown", f"p{k} is unknown: |p{k}| ≤ |{sizes}|{along}"


def _location(location: Table, document: Table) -> Iterator[str]:
    noise = {c["name"] for c in document["coordinates"] if c.get("noise")}
    units = {document.get("constant"), (document.get("decaying") or {}).get("coordinate")}
    every = [c["name"] for c in document["coordinates"] if c["name"] not in noise | units]
    missing = [name for name in every if name not in location["coordinates"]]
    parts = ["no time passes" if location["motion"] is None else f"moves as {location['motion']!r}"]
    if location.get("clock") is not None:
        parts.append(f"for at most {_time(location['clock'])}")
    if location["facts"]:
        parts.append(f"always {_quoted(location['facts'])}")
    parts.append(f"0 here: {', '.join(missing)}" if missing else "all coordinates may differ from 0")
    yield from _wrapped(f"- {location['name']!r}: ", parts, "; ")


def _edge(edge: Table, names: Sequence[str], inside: Sequence[str]) -> Iterator[str]:
    changes, jump = [], edge.get("jump", [])
    has_steps = any(not isinstance(each, list) for each in jump)
    for i, row in enumerate([] if has_steps else jump):
        if not _is_unit(row, i) and (names[i] in inside or not all(map(_is_zero, row))):
            changes.append(f"{names[i]} := {_row(row, names)}")
    target = (
        "nowhere, so a proof has to show that it is never taken" if edge["to"] is None else repr(edge["to"])
    )
    parts = [f"from {edge['from']!r} to {target}"]
    if edge.get("event"):
        parts.append("it counts as an event")
    if edge.get("when") is not None:
        first, last = edge["when"]
        when = _time(last) if _value(first) == _value(last) else f"{_time(first)} to {_time(last)}"
        parts.append(f"when the clock shows {when}")
    if edge["to"] is not None and not has_steps:
        parts.append(_CLOCKS[edge["clock"]])
    if edge["facts"]:
        parts.append(f"if {_quoted(edge['facts'])}")
    if has_steps:
        parts.append(f"lasts {_time(edge.get('duration', 0))}: {', '.join(map(_taken, jump))}")
    elif edge["to"] is not None:
        parts.append(", ".join(changes) if changes else "nothing changes")
    yield from _wrapped(f"- {edge['name']!r}: ", parts, "; ")


def _taken(step: Any) -> str:
    """Return a step of an edge."""
    if isinstance(step, str):
        return repr(step)
    if "repeat" in step:
        return f"{step['times']} times ({', '.join(map(_taken, step['repeat']))})"
    return f"{step['exp']!r} for {_time(step['seconds'])}"


def _step(name: str, step: Table, document: Table) -> Iterator[str]:
    """Yield what a step sets, or how z moves in it."""
    names = [coordinate["name"] for coordinate in document["coordinates"]]
    flows = {
        each["exp"]
        for edge in document["edges"]
        for one in edge.get("jump", [])
        for each in (one.get("repeat", [one]) if isinstance(one, dict) else ())
        if isinstance(each, dict)
    }
    changes = []
    for i, row in enumerate(step["matrix"]):
        if name in flows and not all(map(_is_zero, row)):
            changes.append(f"d/dt {names[i]} = {_row(row, names)}")
        elif name not in flows and not _is_unit(row, i):
            changes.append(f"{names[i]} := {_row(row, names)}")
    yield from _wrapped(f"- {name!r}: {step['words']}: ", changes or ["nothing changes"], ", ")


def _start(start: Table, names: Sequence[str], noise: Sequence[str]) -> Iterator[str]:
    values = []
    for name, row in zip(names, start["columns"], strict=True):
        if name not in noise and not all(map(_is_zero, row)):
            values.append(f"{name} = {_row(row, ['', *noise])}")
    facts = f", if {_quoted(start['facts'])}," if start["facts"] else ""
    yield from _wrapped(f"- starts in {start['location']!r}{facts} with ", values, ", ")


def _output(output: Table, names: Sequence[str], locations: int) -> Iterator[str]:
    unit = f" [{output['unit']}]" if output["unit"] else ""
    where = "" if len(output["in"]) == locations else f", bounded only in {_quoted(output['in'])}"
    if "input" in output:
        what = f"entry {output['input']} of the input"
    else:
        what = "; ".join(_row(row, names) for row in output["rows"])
        if "velocity" in output:
            velocity = "; ".join(_row(row, names) for row in output["velocity"])
            what = f"d/dt of ({velocity}) plus ({what})"
    if output.get("during_edges"):
        where += ", also while edges last"
    yield from _wrapped(f"- output {output['name']}{unit} = ", [f"{what}{where}"], " ")


def _row(row: Sequence[Any], names: Sequence[str]) -> str:
    """Return a combination such as "2 angle − 0.1 e angle"."""
    parts: list[str] = []
    for entry, name in zip(row, names, strict=True):
        if _is_zero(entry):
            continue
        value = abs(_value(entry)) if _is_wide(entry) else _value(entry)
        size = _number(entry) if _is_wide(entry) else _number(abs(value))
        size = "" if size == "1" and abs(value) == 1 and name else size
        sign = "−" if value < 0 else "+"
        term = " ".join(part for part in (size, name) if part)
        parts.append(f"{sign} {term}" if parts else f"{'−' if value < 0 else ''}{term}")
    return " ".join(parts) or "0"


def _value(entry: Any) -> float:
    if isinstance(entry, list):
        return sum(map(_value, entry)) / 2
    return float(Fraction(entry)) if isinstance(entry, str) else float(entry)


def _is_wide(entry: Any) -> bool:
    """Return whether an entry is an interval whose ends are shown."""
    if not isinstance(entry, list):
        return False
    low, high = map(_value, entry)
    return high - low > _NARROW * max(1.0, abs(low), abs(high))


def _is_zero(entry: Any) -> bool:
    return not _is_wide(entry) and _value(entry) == 0


def _is_unit(row: Sequence[Any], index: int) -> bool:
    """Return whether a row has a 1 at an index, and 0 elsewhere."""
    return not any(map(_is_wide, row)) and [_value(v) for v in row] == [
        int(index == j) for j in range(len(row))
    ]


def _number(entry: Any) -> str:
    if _is_wide(entry):
        return f"[{', '.join(map(_number, entry))}]"
    return f"{_value(entry):.{_DIGITS}g}".replace("-", "−")


def _time(entry: Any) -> str:
    return "0" if _value(entry) == 0 else f"{_number(_value(entry) * _MS)} ms"


def _quoted(names: Sequence[str]) -> str:
    return " and ".join(map(repr, names)) if len(names) < 3 else ", ".join(map(repr, names))


def _with_unit(coordinate: Table) -> str:
    return f"{coordinate['name']} [{coordinate['unit']}]" if coordinate["unit"] else str(coordinate["name"])


def _wrapped(begin: str, parts: Sequence[str], joint: str) -> list[str]:
    """Return lines of parts that are joined, the later lines indented."""
    return textwrap.wrap(begin + joint.join(parts), _WIDTH, subsequent_indent="  ", break_on_hyphens=False)
