"""A valid summary is shown; any other is written again."""

import io
import json
import re
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

import pytest
from pydantic import BaseModel
from rich.console import Console

import noack
from cosim.analysis.summary.run_summary import Outcome
from cosim.analysis.summary.summary_model import LoopSummary, NetworkPart, RunSummary, read_summary
from cosim.output.page_kit import document_page
from cosim.output.report_page import Report, report_document
from cosim.output.run_document import run_document
from cosim.output.run_tables import key_numbers
from cosim.record.run_record import RunRecord
from cosim.simulation.virtual_time import simulate
from netem.core.errors import ExitStatus
from netem.output.terminal_writer import print_document
from noack.scenario.resolution import resolve
from noack.scenario.scenario_file import validate
from tests.helpers.summaries import summary_of, with_values

HUGE = 10**400
DELETED = object()
RENAMED = object()
VALUES = [None, HUGE, "[/b]", [[[[]]]], {"a": [1]}, DELETED, RENAMED]
PARTS = (
    "changes", "watchdog", "estimation", "disturbances", "violations",
    "acknowledgements", "actuations", "lateness_us", "latency_us", "realtime", "replay",
    "conditions", "certified_for", "claims", "linearisation", "ideal_loop", "outputs",
)  # fmt: skip
"""What only some runs have."""


def value_of(kind: Any) -> Any:
    """A value of an annotation, with everything that may be missing."""
    arguments = get_args(kind)
    if isinstance(kind, type) and issubclass(kind, BaseModel):
        return {name: value_of(field.annotation) for name, field in kind.model_fields.items()}
    if type(None) in arguments or get_origin(kind) in (Annotated, Literal):
        return arguments[0] if get_origin(kind) is Literal else value_of(arguments[0])
    if get_origin(kind) in (list, tuple):
        return 2 * [value_of(arguments[0])]
    if arguments:
        return {"sensor": value_of(arguments[1])}
    if isinstance(kind, type) and issubclass(kind, Enum):
        return next(iter(kind)).value
    return {int: 1, float: 0.5, bool: False, str: "x"}.get(kind)


@pytest.fixture(scope="module")
def record() -> RunRecord:
    return simulate(resolve(noack.load("double_integrator", {"horizon_s": 0.2})))


@pytest.fixture(scope="module")
def summary(record: RunRecord) -> dict[str, Any]:
    full = {name: value_of(LoopSummary.model_fields[name].annotation) for name in PARTS}
    return summary_of(record, kind="live", **full).to_json()


def test_full_summary_can_be_shown(record: RunRecord, summary: dict[str, Any]) -> None:
    full = read_summary(summary)
    assert full is not None
    for replayed in ({"bit_exact": True, "inputs": 4}, {"bit_exact": None, "error": "empty"}, None):
        show(record, with_values(full, replay=replayed))


def test_a_damaged_summary_is_shown_or_detected(record: RunRecord, summary: dict[str, Any]) -> None:
    shown = 0
    for place in places(summary):
        for value in VALUES if place[0] != "exit" else ():  # which is read first (test_finalize)
            damaged = changed(summary, place, value)
            if (readable := read_summary(damaged)) is not None:
                show(record, readable)
                shown += 1
    assert shown > 100  # numbers that may be missing, keys that are not shown


def places(value: Any, prefix: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if prefix:
        yield prefix
    inner: Any = ()
    if isinstance(value, dict):
        inner = value.items()
    elif isinstance(value, list):
        inner = enumerate(value[:1])
    for key, part in inner:
        yield from places(part, (*prefix, key))


def changed(summary: dict[str, Any], place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    """The summary with one key replaced, removed or renamed."""
    copied: dict[str, Any] = json.loads(json.dumps(summary))  # a copy, sooner than copy.deepcopy's
    table: Any = copied
    for key in place[:-1]:
        table = table[key]
    old_value = table.pop(place[-1])
    if value is RENAMED and isinstance(table, dict):
        table["[/b]"] = old_value
    elif value is not DELETED and isinstance(table, dict):
        table[place[-1]] = value
    elif value is not DELETED:
        table.insert(place[-1], value)
    return copied


def show(record: RunRecord, summary: RunSummary) -> None:
    """Every function that reads a summary."""
    outcome = Outcome(Path("run"), ExitStatus.OK, "horizon", summary)
    print_document(Console(file=io.StringIO()), run_document(outcome))
    document_page(report_document(Report(summary, record.scenario, 0)))
    run = noack.Run(outcome.run_dir, lambda: outcome)
    assert repr(run)
    assert run._repr_html_()


def test_the_docs_list_every_key() -> None:
    text = (Path(__file__).parents[4] / "docs" / "record.md").read_text(encoding="utf-8")
    rows = [line.split(" | ")[0] for line in text[text.index("\n## The summary") :].splitlines()]
    keys = [key for row in rows if row.startswith("| `") for key in re.findall(r"`(\w+)`", row)]
    expected = [*RunSummary.model_fields, *NetworkPart.model_fields, *LoopSummary.model_fields]
    assert sorted(keys) == sorted(expected)


# --- figures of a run -----------------------------------------------------------------------------


def simulated(content: dict[str, Any]) -> RunRecord:
    return simulate(resolve(validate(content, "")))


def test_the_expected_loss_rate_is_shown_beside_the_measured_one(content: dict[str, Any]) -> None:
    """With loss probability p and cap N, Σ_{k=1…N} p^k drops are expected for each delivery."""
    summary = summary_of(simulated(content))
    drops = 0.5 + 0.5**2
    assert summary.loops[0].loss_expected == pytest.approx(drops / (1 + drops))
    assert ("  expected loss rate", "42.9 %") in key_numbers(summary)
    change = {"at_s": 0.5, "set": {"network.loss.probability": 0.2}}
    summary = summary_of(simulated(content | {"changes": [change]}))
    assert summary.loops[0].loss_expected is None
    assert not any("expected loss" in quantity for quantity, _ in key_numbers(summary))
