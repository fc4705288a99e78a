"""Scenario files and ``--set``: plain text or, after a zero byte, edited valid content."""

import tomllib
from typing import Any

import tomli_w

from noack.scenario.resolution import resolve
from noack.scenario.scenario import Scenario
from noack.scenario.scenario_file import dumps, load, validate
from noack.scenario.toml_file import json_schema
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.edits import bases, edited, key, quoted, value, vocabulary, write_named
from tests.fuzz.harness import FOLDER, refusal, workspace

KNOWN = vocabulary(json_schema(Scenario), dates=True)
SEEDS = [
    *EDITS,
    *(path.read_bytes() for path in sorted((FOLDER.parents[1] / "scenarios").glob("*.toml"))),
]
WORDS = quoted(KNOWN)
BASES = bases(
    "scenarios",
    {
        "name": "all",
        "horizon_s": 1.0,
        "model": {"A": [[0.0, 1.0], [0.0, 0.0]], "B": [[0.0], [1.0]], "gain": [[-1.0, -1.5]]},
        "plant": {
            "initial_state": [1.0, 0.0], "initial_state_halfwidth": [0.1, 0.0], "draw": "vertex",
            "uncertainty_A": [[0.1, 0.0], [0.0, 0.1]],
        },
        "trigger": {"policy": "dynamic", "sigma": 0.1, "decay_per_s": 1.0, "theta": 1.0},
        "network": {
            "mansd": 2,
            "loss": {"model": "trace", "file": "trace.txt"},
            "impairments": [
                {"kind": "delay", "distribution": "empirical", "file": "delays.txt"},
                {"kind": "reorder", "probability": 0.1},
                {"kind": "rate", "rate_bps": 1_000_000},
                {"kind": "blackout", "intervals_s": [[0.1, 0.2]]},
            ],
        },
    },
)  # fmt: skip


def one_input(data: bytes) -> None:
    overrides: list[str] = []
    if data[:1] == b"\0":
        choices = Choices(data[1:])
        base = choices.one(BASES)
        for _ in range(choices.below(3)):
            name = ".".join(key(choices, KNOWN) for _ in range(1 + choices.below(3)))
            overrides.append(f"{name}={_written(choices)}" if choices.below(8) else name)
        data = tomli_w.dumps(edited(choices, base, KNOWN)).encode()
    path = write_named(workspace(), "scenario.toml", data)
    with refusal((str(path), "--set"), lines=True):
        scenario = load(path, overrides)
        _assert_reads_back(scenario)
        with refusal():
            resolved = resolve(scenario)
            _assert_reads_back(resolved)
            assert resolve(resolved) == resolved


def _written(choices: Choices) -> str:
    """Return a value of ``--set``, as TOML or as any text."""
    if choices.below(4) == 0:
        return choices.text()
    content: dict[str, Any] = {"x": value(choices, KNOWN)}
    return tomli_w.dumps(content).partition("=")[2].strip()


def _assert_reads_back(scenario: Scenario) -> None:
    text = dumps(scenario)
    assert validate(tomllib.loads(text), "again") == scenario
    assert dumps(validate(tomllib.loads(text), "again")) == text
