"""Prometheus's text format, exposition format 0.0.4, as a test reads it."""

import re
from collections.abc import Mapping
from typing import NamedTuple

_NAME = "[a-zA-Z_:][a-zA-Z0-9_:]*"
_LABEL = r'([a-zA-Z_]\w*)="((?:[^"\\\n]|\\[\\"n])*)"'
_SAMPLE = re.compile(rf"({_NAME})(?:\{{({_LABEL}(?:,{_LABEL})*)\}})? (\S+)")


class Family(NamedTuple):
    """A metric and its samples, by name and labels."""

    kind: str
    samples: dict[tuple[str, frozenset[tuple[str, str]]], float]


def parsed(text: str) -> dict[str, Family]:
    """Read the exposition format 0.0.4: HELP and TYPE of each metric, then its samples."""
    assert text.endswith("\n")
    families: dict[str, Family] = {}
    lines = iter(text.splitlines())
    for line in lines:
        if line.startswith("# HELP "):
            name, _, meaning = line.removeprefix("# HELP ").partition(" ")
            assert re.fullmatch(_NAME, name)
            assert meaning.endswith(".")
            hash_mark, word, same, kind = next(lines).split(" ")
            assert (hash_mark, word, same) == ("#", "TYPE", name)
            assert name not in families
            families[name] = Family(kind, {})
            continue
        sample = _SAMPLE.fullmatch(line)
        assert sample is not None, line
        labels = re.findall(_LABEL, sample[2] or "")
        assert len(dict(labels)) == len(labels)
        base = sample[1]
        if families[name].kind == "histogram":
            base = re.sub("_(bucket|count)$", "", base)
        assert base == name, "samples of a metric stand together"
        key = sample[1], frozenset(labels)
        assert key not in families[name].samples
        families[name].samples[key] = float(line.rpartition(" ")[2])
    return families


def of(families: Mapping[str, Family], name: str, **labels: str) -> float:
    family = families[re.sub("_(bucket|count)$", "", f"noack_netem_{name}")]
    return family.samples[f"noack_netem_{name}", frozenset(labels.items())]
