"""What a terminal shows of a run: its colours, warnings and reasons."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from cosim.analysis.summary.run_summary import Outcome
from cosim.analysis.summary.summary_model import Claim
from cosim.live.finalize import finalize
from cosim.output.run_document import run_document
from cosim.simulation.virtual_time import simulate_run
from netem.output.terminal_writer import print_document
from tests.helpers.shipped import shipped
from tests.helpers.summaries import claim, with_values

RED = "\x1b[1;31m"


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The paper's example, completed without problems."""
    ending = simulate_run(shipped("lane_following"), tmp_path_factory.mktemp("runs"))
    return finalize(ending, report=False, view=False)


def printed(outcome: Outcome, *, verbose: bool = False, **changed: Any) -> str:
    """The output on a terminal of 80 columns, colours included."""
    file = io.StringIO()
    console = Console(file=file, width=80, force_terminal=True, color_system="standard")
    changed_outcome = replace(outcome, summary=with_values(outcome.summary, **changed))
    print_document(console, run_document(changed_outcome, verbose=verbose))
    return file.getvalue()


def test_the_table_of_times_marks_what_was_later_than_allowed(outcome: Outcome) -> None:
    assert "(late)" not in printed(outcome, verbose=True)
    conditions = outcome.summary.loops[0].conditions
    assert conditions is not None
    late = conditions.model_copy(update={"hold_s": 0.0125}).model_dump()
    (row,) = [
        line for line in printed(outcome, verbose=True, conditions=late).splitlines()
        if "(late)" in line
    ]  # fmt: skip
    assert "age of an input" in row
    assert "12.5 ms" in row


def test_reasons_of_several_loops_that_differ_only_in_numbers_are_one_line(tmp_path: Path) -> None:
    outcome = finalize(
        simulate_run(shipped("different_loops", "horizon_s=1"), tmp_path), report=False, view=False
    )
    reasons = ["an input was old", "gain 1.5, not below 1", "gain 2.25, not below 1", "gain 1.5, not below 1"]
    loops = [
        loop.model_copy(update={"claims": [Claim(**claim("unchecked", cause="no certificate", detail=why))]})
        for loop, why in zip(outcome.summary.loops, reasons, strict=True)
    ]
    summary = outcome.summary.model_copy(update={"loops": loops})
    print_document(Console(file=(file := io.StringIO())), run_document(replace(outcome, summary=summary)))
    assert [line for line in file.getvalue().splitlines() if line.startswith("claims ended or")] == [
        "claims ended or unchecked: no certificate: gain 1.5 to 2.25, not below 1 (3 loops)",
        f"claims ended or unchecked: no certificate: an input was old ({loops[0].name})",
    ]


def test_a_broken_guarantee_is_shown_as_an_error(outcome: Outcome) -> None:
    lost = {"t_s": 2.5, "process": "controller", "cause": "dropouts", "what": "MANSD violated: 6 lost"}
    later_violations = [lost | {"what": f"MANSD violated: {n} lost"} for n in range(7, 13)]
    text = printed(outcome, violations=[lost, *later_violations])
    assert text.count("controller reported at 2.500 s: MANSD") == 5
    assert "1 more report of this kind" in text
    assert RED in text
