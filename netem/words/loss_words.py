"""Losses in words: what follows ``loss``."""

import re
from typing import Any

from netem.words.quantities import (
    CORRELATION,
    COUNT,
    NUMBER,
    PERCENT,
)
from netem.words.word_reader import WordReader

LOSS_MODELS = (
    "random", "state", "gemodel", "burst", "periodic", "trace", "script", "worst", "none",
)  # fmt: skip
"""Words after ``loss``."""
_NAMES = {
    "bernoulli": "loss PERCENT, e.g. loss 30%",
    "gilbert": "loss gemodel or loss burst",
    "four": "loss state",
    "lossless": "loss none",
    "worst_case": "loss worst",
}
"""What the models are called elsewhere begins so."""
_PERIODIC = "losses per datagrams, e.g. 2/100"
_SCRIPT = "the numbers of the lost datagrams, counted from 0, e.g. 3,4,17; or none"

Table = dict[str, Any]
"""A table of settings, before it is validated."""


def read_loss(reader: WordReader) -> Table:
    """Read what follows ``loss``; return the loss model as a table."""
    if reader.number_follows():
        return _bernoulli(reader)
    word = reader.word(f"a percentage, e.g. 5%, or one of {', '.join(LOSS_MODELS)}")
    for name, here in _NAMES.items():
        if word.startswith(name):
            reader.wrong(f"no such word; here it is {here}")
    match reader.choose(word, LOSS_MODELS):
        case "random":
            return _bernoulli(reader)
        case "state":
            return _four_state(reader)
        case "gemodel":
            return _gilbert_elliott(reader)
        case "burst":
            mean_loss = reader.value(PERCENT)
            means = {"mean_loss": mean_loss, "mean_burst": reader.value(NUMBER)}
            return {"model": "gilbert_elliott", **means}
        case "periodic":
            return _periodic(reader)
        case "trace":
            file = reader.file("a file of zeros and ones")
            return {"model": "trace", "file": file, "repeat": not reader.accept("once")}
        case "script":
            return _script(reader)
        case "worst":
            return {"model": "worst_case"}
        case _:
            return {"model": "lossless"}


def _bernoulli(reader: WordReader) -> Table:
    table: Table = {"model": "bernoulli", "probability": reader.value(PERCENT)}
    if reader.number_follows():
        table["correlation"] = reader.value(CORRELATION)
    return table


def _four_state(reader: WordReader) -> Table:
    """``state p13 [p31 [p32 [p23 [p14]]]]``; p13 alone makes independent losses, as in tc."""
    p13 = reader.value(PERCENT)
    table: Table = {"model": "four_state", "p13": p13, "p31": 1 - p13}
    for key in ("p31", "p32", "p23", "p14"):
        if not reader.number_follows():
            break
        table[key] = reader.value(PERCENT)
    return table


def _gilbert_elliott(reader: WordReader) -> Table:
    """``gemodel p [r [1-h [1-k]]]``; p alone makes independent losses, as in tc."""
    p = reader.value(PERCENT)
    table: Table = {"model": "gilbert_elliott", "good_to_bad": p, "bad_to_good": 1 - p}
    for key in ("bad_to_good", "loss_in_bad", "loss_in_good"):
        if not reader.number_follows():
            break
        table[key] = reader.value(PERCENT)
    return table


def _periodic(reader: WordReader) -> Table:
    found = re.fullmatch("([0-9]+)/([0-9]+)", reader.word(_PERIODIC))
    if found is None:
        reader.wrong(f"expected {_PERIODIC}")
    burst, period = (reader.read(part, COUNT) for part in found.groups())
    table: Table = {"model": "periodic", "burst": burst, "period": period}
    if reader.accept("from"):
        table["first"] = reader.value(COUNT)
    return table


def _script(reader: WordReader) -> Table:
    lost = [] if reader.accept("none") else reader.values(COUNT, _SCRIPT)
    table: Table = {"model": "scripted", "lost": lost}
    if reader.accept("every"):
        table["repeat_every"] = reader.value(COUNT)
    return table
