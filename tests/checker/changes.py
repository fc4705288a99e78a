"""Changes of documents and of loops: of a document by forms, of one by gains, and of what it is about."""

from collections.abc import Callable
from typing import Any

import numpy as np
from flint import fmpq

from noack.core.balls import number
from noack.proof.elaborate.errors import RejectedError
from noack.proof.elaborate.loop import Loop
from noack.proof.search.results import Proof
from noack.proof.statement_proof import prove_statement

Document = dict[str, Any]
Rng = np.random.Generator


def accepted(loop: Loop, document: Document) -> Proof | None:
    """Return what a document proves, or None if it is rejected."""
    try:
        return prove_statement(loop, document)
    except RejectedError:
        return None


# Documents by forms.


def _entry(document: Document, rng: Rng) -> Document:
    return document["bounds"][rng.integers(len(document["bounds"]))]  # type: ignore[no-any-return]


def _number_of(document: Document, rng: Rng, start: str = "") -> tuple[Document, str]:
    numbers = _entry(document, rng)["numbers"]
    names = [name for name in numbers if name.startswith(start)] or list(numbers)
    return numbers, names[rng.integers(len(names))]


def _scaled_number(document: Document, rng: Rng, start: str, factor: float) -> None:
    numbers, name = _number_of(document, rng, start)
    numbers[name] *= float(factor)


def _other_digit(document: Document, rng: Rng) -> None:
    numbers, name = _number_of(document, rng)
    text = f"{numbers[name]:.6e}"
    place = rng.choice([i for i, c in enumerate(text) if c.isdigit()])
    numbers[name] = float(text[:place] + str(rng.integers(10)) + text[place + 1 :])


def _changed_matrix(document: Document, rng: Rng, change: Callable[[Any], Any]) -> None:
    matrices = _entry(document, rng)["matrices"]
    name = rng.choice(list(matrices))
    M = change(np.array(matrices[name]))
    matrices[name] = ((M + M.T) / 2).tolist()


def _one_entry(document: Document, rng: Rng) -> None:
    def change(M: Any) -> Any:
        i, j = rng.integers(len(M), size=2)
        M[i, j] = M[j, i] = M[i, j] * rng.choice([0.99, 1.01])
        return M

    _changed_matrix(document, rng, change)


def _swapped_numbers(document: Document, rng: Rng) -> None:
    start = rng.choice(["c", "a/", "m/flow", "m/edge", "m/output"])
    numbers, first = _number_of(document, rng, start)
    second = rng.choice([name for name in numbers if name.startswith(start)] or list(numbers))
    numbers[first], numbers[second] = numbers[second], numbers[first]


def _swapped_locations(document: Document, rng: Rng) -> None:
    entry = _entry(document, rng)
    M, most = entry["matrices"], max(np.shape(each) for each in entry["matrices"].values())
    first, second = rng.choice([name for name in M if np.shape(M[name]) == most], 2, replace=False)
    M[first], M[second] = M[second], M[first]


def _another_label(document: Document, rng: Rng) -> None:
    first, second = rng.choice(len(document["bounds"]), 2, replace=False)
    entries = document["bounds"]
    entries[first]["output"], entries[second]["output"] = entries[second]["output"], entries[first]["output"]


def _scaled_entry(document: Document, rng: Rng) -> None:
    """Change all forms by one factor, but not the levels."""
    entry, factor = _entry(document, rng), float(rng.choice([0.9, 1.1]))
    entry["matrices"] = {name: (factor * np.array(M)).tolist() for name, M in entry["matrices"].items()}
    for name in entry["numbers"]:
        if not name.startswith("level"):
            entry["numbers"][name] *= factor


def _scaled(key: str, factor: float) -> Callable[[Document, Rng], None]:
    def change(document: Document, rng: Rng) -> None:
        tables = [document, _entry(document, rng)]
        table = next((each for each in tables if key in each), document)
        table[key] = table.get(key, 1.0) * factor

    return change


def _scale_errors(document: Document, factor: float) -> None:
    """Change what is assumed of the errors, if anything is."""
    if "errors" in document:
        document["errors"] = {unit: factor * size for unit, size in document["errors"].items()}


DOCUMENTS: dict[str, Callable[[Document, Rng], object]] = {
    "multiplier 0": lambda d, rng: _scaled_number(d, rng, "m/", 0.0),
    "multiplier of an edge 0": lambda d, rng: _scaled_number(d, rng, "m/edge", 0.0),
    "multiplier of a comparison 0": lambda d, rng: _scaled_number(d, rng, "a/", 0.0),
    "multiplier of the other sign": lambda d, rng: _scaled_number(d, rng, "m/", -1.0),
    "multiplier doubled": lambda d, rng: _scaled_number(d, rng, "m/", 2.0),
    "level 1 % smaller": lambda d, rng: _scaled_number(d, rng, "level", 0.99),
    "level 1 % larger": lambda d, rng: _scaled_number(d, rng, "level", 1.01),
    "another c": lambda d, rng: _scaled_number(d, rng, "c", rng.choice([-1.0, 0.98, 1.02])),
    "another digit": _other_digit,
    "one entry": _one_entry,
    "a matrix of the other sign": lambda d, rng: _changed_matrix(d, rng, lambda M: -M),
    "a scaled matrix": lambda d, rng: _changed_matrix(d, rng, lambda M: M * rng.choice([0.97, 1.03])),
    "scaled forms": _scaled_entry,
    "numbers swapped": _swapped_numbers,
    "locations swapped": _swapped_locations,
    "outputs swapped": _another_label,
    "rate + 5 %": _scaled("rate", 1.05),
    "rate - 5 %": _scaled("rate", 0.95),
    "decay + 5 %": _scaled("decay", 1.05),
    "decay - 5 %": _scaled("decay", 0.95),
    "inter-event time + 5 %": _scaled("inter_event_s", 1.05),
    "inter-event time x 2": _scaled("inter_event_s", 2.0),
    "inter-event time - 5 %": _scaled("inter_event_s", 0.95),
    "errors - 5 %": lambda d, rng: _scale_errors(d, 0.95),
    "errors + 5 %": lambda d, rng: _scale_errors(d, 1.05),
    "one later event more": lambda d, rng: d.update(later=d["later"] + 1),
    "one later event less": lambda d, rng: d.update(later=max(d["later"] - 1, 0)),
    "another number of pieces": lambda d, rng: d.update(pieces=int(rng.integers(1, 9))),
    "other events before the first input": lambda d, rng: d.update(later_at_start=int(rng.integers(0, 3))),
}

# Loops.


def _one_of(field: str, factors: tuple[float, ...] = (0.98, 1.02)) -> Callable[[Loop, Rng], Loop]:
    def change(loop: Loop, rng: Rng) -> Loop:
        M = getattr(loop, field) * 1
        found = [(i, j) for i in range(M.nrows()) for j in range(M.ncols()) if M[i, j] != 0]
        for i, j in found[rng.integers(len(found)) :][:1] if found else []:
            M[i, j] = M[i, j] * number(rng.choice(factors))
        return loop._replace(**{field: M})

    return change


def _time(field: str, factor: int) -> Callable[[Loop, Rng], Loop]:
    def change(loop: Loop, rng: Rng) -> Loop:
        times = loop.times._replace(**{field: getattr(loop.times, field) * factor})
        return loop._replace(times=times)

    return change


def _periods(factor: fmpq, fields: tuple[str, ...]) -> Callable[[Loop, Rng], Loop]:
    """Change the times between the events of a periodic rule."""

    def change(loop: Loop, rng: Rng) -> Loop:
        changed = {field: getattr(loop.times, field) * factor for field in fields}
        return loop._replace(times=loop.times._replace(**changed))

    return change


def _rule(field: str, factor: float) -> Callable[[Loop, Rng], Loop]:
    def change(loop: Loop, rng: Rng) -> Loop:
        return loop._replace(rule=loop.rule._replace(**{field: getattr(loop.rule, field) * number(factor)}))

    return change


def _of_observer(field: str, factor: float) -> Callable[[Loop, Rng], Loop]:
    def change(loop: Loop, rng: Rng) -> Loop:
        if loop.observer is None:
            return loop
        value = getattr(loop.observer, field)
        if field == "gains":
            scaled = tuple(gain * number(factor) for gain in value)
        else:
            scaled = value * factor if field == "period" else value * number(factor)
        times = loop.times
        if field == "period":
            times = times._replace(sampling=scaled, least_sampling=scaled)
        return loop._replace(observer=loop.observer._replace(**{field: scaled}), times=times)

    return change


LOOPS: dict[str, Callable[[Loop, Rng], Loop]] = {
    "one loss more": lambda loop, rng: loop._replace(losses=loop.losses + 1),
    "one loss less": lambda loop, rng: loop._replace(losses=loop.losses - 1),
    "two losses more": lambda loop, rng: loop._replace(losses=loop.losses + 2),
    "A": _one_of("A"),
    "B": _one_of("B"),
    "model A": _one_of("model_A"),
    "model B": _one_of("model_B"),
    "K": _one_of("gain"),
    "K of the other sign": _one_of("gain", (-1.0,)),
    "W": _one_of("weight"),
    "box + 2 %": _one_of("half_B", (1.02,)),
    "box - 2 %": _one_of("half_A", (0.98,)),
    "a state 1 % off": _one_of("start", (1.01,)),
    "a smaller start": _one_of("start", (0.99,)),
    "start of the other sign": lambda loop, rng: loop._replace(start=loop.start * -1),
    "another push": _one_of("pushes"),
    "larger disturbance": lambda loop, rng: loop._replace(sizes=tuple(s * number(1.1) for s in loop.sizes)),
    "another observer": _of_observer("gains", 0.98),
    "another estimate": _of_observer("start", 1.02),
    "a much worse estimate": _of_observer("start", 20.0),
    "tests of the observer half as often": _of_observer("period", 2),
    "noise + 5 %": _one_of("noise", (1.05,)),
    "noise - 5 %": _one_of("noise", (0.95,)),
    "noise of another direction": _one_of("noise", (-1.0,)),
    "twice the noise": lambda loop, rng: loop._replace(noise=loop.noise * 2),
    "no noise": lambda loop, rng: loop._replace(noise=loop.noise * 0),
    "level + 5 %": _rule("level", 1.05),
    "level - 5 %": _rule("level", 0.95),
    "floor + 5 %": _rule("floor", 1.05),
    "floor - 5 %": _rule("floor", 0.95),
    "rate + 5 %": _rule("rate", 1.05),
    "rate - 5 %": _rule("rate", 0.95),
    "another rule": lambda loop, rng: loop._replace(rule=loop.rule._replace(positive=loop.rule.positive * 2)),
    "holds": lambda loop, rng: loop._replace(holds=True),
    "sampling x 2": _time("sampling", 2),
    "delay x 2": _time("delay", 2),
    "delay x 4": _time("delay", 4),
    "age x 2": _time("age", 2),
    "start x 2": _time("start", 2),
    "start x 4": _time("start", 4),
    "no delay": _time("delay", 0),
    "no age": _time("age", 0),
    "no start": _time("start", 0),
    "period x 2": _periods(fmpq(2), ("least_period", "period")),
    "period 5 % longer": _periods(fmpq(21, 20), ("period",)),
    "period 5 % shorter": _periods(fmpq(19, 20), ("least_period", "period")),
    "least period 5 % shorter": _periods(fmpq(19, 20), ("least_period",)),
}


# Documents by gains.


def places(table: Document, *keys: str) -> list[tuple[Any, Any]]:
    """Return where the numbers of a table are, each as a container and its key."""
    found: list[tuple[Any, Any]] = []
    pending = [(table, key) for key in keys if key in table]
    while pending:
        container, key = pending.pop()
        value = container[key]
        if isinstance(value, dict | list):
            pending += [(value, k) for k in (value if isinstance(value, dict) else range(len(value)))]
        else:
            found.append((container, key))
    return found


def scaled(*keys: str) -> Callable[[Document, Rng], None]:
    """Scale one number of some entries, by a little or by much; a number that is 0 is set."""

    def change(document: Document, rng: Rng) -> None:
        found = places(document.get("gains", {}), *keys) or places(document, *keys)
        if found:
            container, key = found[rng.integers(len(found))]
            factor = rng.choice([-1.0, 0.0, 0.5, 0.9, 0.99, 0.999, 1.001, 1.01, 1.1, 2.0, 10.0])
            container[key] = container[key] * factor if container[key] else factor / 100

    return change


def all_scaled(*keys: str) -> Callable[[Document, Rng], None]:
    """Scale all numbers of some entries by one factor."""

    def change(document: Document, rng: Rng) -> None:
        factor = rng.choice([0.2, 0.7, 0.98, 0.999, 1.001, 1.02, 1.5, 5.0])
        for container, key in places(document.get("gains", {}), *keys) or places(document, *keys):
            container[key] *= factor

    return change


def without(document: Document, rng: Rng) -> None:
    """Leave out an entry."""
    tables = [document["gains"], *(table for table in document["gains"].values() if isinstance(table, dict))]
    table = tables[rng.integers(len(tables))]
    del table[rng.choice(list(table))]


def swapped(document: Document, rng: Rng) -> None:
    """Let two tables change places."""
    gains = document["gains"]
    pairs = [("plant", "model"), ("outputs", "inputs")]
    pairs += [("errors", "shift"), ("errors", "share"), ("shift", "share")] if "comparison" in gains else []
    first, second = pairs[rng.integers(len(pairs))]
    table = gains if first in gains else gains["comparison"]
    if second in table:
        table[first], table[second] = table[second], table[first]


def another_rule(document: Document, rng: Rng) -> None:
    """Take the rule for another one, or an integral over more or less, or over another time."""
    gains = document["gains"]
    kind = rng.integers(4) if "window_s" not in gains else 3
    if kind == 3:
        gains["window_s"] = gains.get("window_s", 1.0) * rng.choice(WINDOWS)
    elif kind == 0:
        gains["by_time"] = not gains.get("by_time", False)
    elif kind == 1:
        gains["tests"] = int(rng.choice([0, 1, 2, 5, 10, 40, 1000]))
    else:
        gains["tests"] = float(rng.choice([0.5, 1.0, 12.0]))


WINDOWS = [-1.0, 0.0, 1e-6, 0.02, 0.2, 0.5, 0.9, 1.1, 2.0, 10.0, 1e9, np.inf, np.nan]
GAINS: dict[str, Callable[[Document, Rng], None]] = {
    "rate": scaled("rate"),
    "time between events": scaled("inter_event_s"),
    "a number of a tail": scaled("plant", "model"),
    "a form of a tail": all_scaled("plant", "model"),
    "inputs": scaled("inputs"),
    "a number of Y, J or S": scaled("comparison"),
    "Y": all_scaled("comparison"),
    "an entry less": without,
    "two tables": swapped,
    "another rule": another_rule,
}
