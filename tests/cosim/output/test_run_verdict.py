"""The end of a run: what its lines and its table say, and no warning without a cause."""

import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import noack
from cosim.analysis.summary.run_summary import Outcome
from cosim.analysis.summary.summary_model import Claim
from cosim.live.finalize import finalize, reopen
from cosim.output.run_tables import short_numbers
from cosim.output.run_verdict import print_outcome, remarks, state_text, verdict
from cosim.simulation.virtual_time import simulate_run
from tests.helpers.approved import compare_lines
from tests.helpers.shipped import shipped
from tests.helpers.summaries import with_values

RED, RED_STYLE = "\x1b[1;31m", "bold red"
LOST = {"t_s": 2.5, "process": "controller", "cause": "dropouts", "what": "MANSD violated: 6 lost"}
LATE = {"t_s": 1.0, "process": "recorder", "cause": "hold", "what": "an input was old"}


def claim(verdict: str, **more: Any) -> dict[str, Any]:
    return {
        "what": "a", "source": "certificate", "bound": "c", "ratio": 1.0, "since_s": 1.0, "why": "",
        "verdict": verdict, "certified": 1.0, "observed": 1.0, "from_s": 0.0, "until_s": None, **more,
    }  # fmt: skip


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The paper's example, completed without problems."""
    ending = simulate_run(shipped("lane_following"), tmp_path_factory.mktemp("runs"))
    return finalize(ending, report=False, view=False)


def printed(outcome: Outcome, *, verbose: bool = False, **changed: Any) -> str:
    """The output on a terminal of 80 columns, colours included."""
    file = io.StringIO()
    console = Console(file=file, width=80, force_terminal=True, color_system="standard")
    print_outcome(console, replace(outcome, summary=with_values(outcome.summary, **changed)), verbose=verbose)
    return file.getvalue()


def test_the_second_line_states_whether_the_guarantee_was_kept(outcome: Outcome) -> None:
    """A line of the file has the summary's claims, each with what it has of its own, and other parts."""

    def stated(line: str) -> list[str]:
        changed = json.loads(line)
        changed["claims"] = [claim(**one) for one in changed["claims"]]
        text, style = verdict(with_values(outcome.summary, **changed))[1]
        return [f"{style}: {text}"]

    compare_lines(Path(__file__).with_name("approved") / "verdicts.txt", stated)


@pytest.mark.parametrize(
    ("first", "largest", "final", "diverged_at_s", "text"),
    [
        (2.0, 2.0, 0.1999, None, "stable, ‖x‖ fell from 2 to 0.2"),
        (1.0, 2.0, 0.1999, None, "stable, ‖x‖ rose from 1 to 2, then fell to 0.2"),
        (1.0, 2.0, 0.2001, None, "bounded, ‖x‖ was at most 2, at the end 0.2"),
        (1.0, 2.0, 9.0, 1.0, "diverged"),
        (None, None, None, None, ""),
    ],
)
def test_the_state_is_stable_bounded_or_diverged(
    first: float | None,
    largest: float | None,
    final: float | None,
    diverged_at_s: float | None,
    text: str,
) -> None:
    assert state_text(first, largest, final, diverged_at_s) == text


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


def test_at_a_set_point_the_state_is_the_distance_from_it() -> None:
    scenario = noack.load("double_integrator", {"controller.setpoint": [3.0, 0.0]})
    summary = noack.simulate(scenario).summary
    loop = summary.loops[0]
    assert loop.setpoint == [3.0, 0.0]
    assert loop.initial_state_norm == 2.0
    assert "stable, ‖x − x_r‖ fell from 2 to " in verdict(summary)[0].text


def test_the_verdict_of_several_loops_counts_them() -> None:
    summary = noack.simulate(noack.load("different_loops", {"horizon_s": 2.0})).summary
    first, second, _ = verdict(summary)
    assert re.fullmatch(r"completed 2 s: \d of 4 loops (stable|bounded).*", first.text)
    assert re.fullmatch(r"guarantee kept in all 4 loops: \d+ claims held, none violated", second.text)
    loops = [*summary.loops]
    loops[2] = loops[2].model_copy(update={"claims": [Claim(**claim("violated"))]})
    broken = verdict(summary.model_copy(update={"loops": loops}))[1]
    name = loops[2].name
    assert broken == (
        f"guarantee broken in 1 of 4 loops, since 1.000 s: {name}: violated: a",
        RED_STYLE,
    )


def test_reasons_of_several_loops_that_differ_only_in_numbers_are_one_line(tmp_path: Path) -> None:
    outcome = finalize(simulate_run(shipped("different_loops"), tmp_path), report=False, view=False)
    reasons = ["an input was old", "gain 1.5, not below 1", "gain 2.25, not below 1", "gain 1.5, not below 1"]
    loops = [
        loop.model_copy(update={"claims": [Claim(**claim("void", why=why))]})
        for loop, why in zip(outcome.summary.loops, reasons, strict=True)
    ]
    summary = outcome.summary.model_copy(update={"loops": loops})
    print_outcome(Console(file=(file := io.StringIO())), replace(outcome, summary=summary))
    assert [line for line in file.getvalue().splitlines() if line.startswith("void: ")] == [
        "void: gain 1.5 to 2.25, not below 1 (3 loops)",
        f"void: an input was old ({loops[0].name})",
    ]


def test_a_broken_guarantee_is_shown_as_an_error(outcome: Outcome) -> None:
    again = [LOST | {"what": f"MANSD violated: {n} lost"} for n in range(7, 13)]
    text = printed(outcome, assumption_violations=[LOST, *again])
    assert text.count("assumption violated at t = 2.500 s (reported by controller): MANSD") == 5
    assert "1 more violation of an assumption" in text
    assert RED in text


def test_a_run_across_hosts_names_the_firewall_the_network_and_what_to_collect(
    outcome: Outcome,
) -> None:
    found: dict[str, Any] = {
        "kind": "live", "unintended_losses": 3, "unintended_losses_by_leg": {"actuation": 3},
        "assumption_violations": [LATE],
        "claims": [claim("void", why=LATE["what"])], "replay": {"complete": False, "bit_exact": None},
    }  # fmt: skip

    def texts(clock_error_s: float | None) -> str:
        conditions = dict.fromkeys(("dropouts", "sampling_s", "delay_s", "hold_s", "start_s"))
        summary = with_values(
            outcome.summary, conditions=conditions | {"clock_error_s": clock_error_s}, **found
        )
        return "\n".join(one.text for one in remarks(summary))

    across, alone = texts(1e-4), texts(None)
    for named in ("firewalls must pass", "the network between hosts was later", "noack collect"):
        assert named in across
        assert named not in alone
    assert "lost elsewhere (kernel): 3 on actuation" in alone


def test_the_longest_burst_is_shown_with_the_limit_of_all_rules(outcome: Outcome) -> None:
    assert "longest loss burst (cap M − 1 = 4)" in dict(short_numbers(outcome.summary))
    change = {"number": 1, "t_s": 1.0, "settings": {"network.mansd": 9}, "what": ""}
    raised = with_values(outcome.summary, changes=[change | {"in_force_from_s": {}}])
    assert "longest loss burst (cap M − 1 = 9)" in dict(short_numbers(raised))
    limited = with_values(outcome.summary, constraints=["atmost 3 in 8"])
    assert "longest loss burst (at most 3 allowed)" in dict(short_numbers(limited))


@pytest.mark.usefixtures("no_report", "no_recording")
def test_an_assumption_that_a_scenario_violates_is_a_warning() -> None:
    trigger = {"policy": "absolute", "delta": 0.02}
    run = noack.simulate(noack.load("double_integrator", {"trigger": trigger}))
    assert "warning:" in (text := printed(reopen(run.directory)))
    assert "assumption violated: the trigger is" in text


@pytest.mark.parametrize("scenario", ["four_tank", "lane_acknowledged"])
def test_the_table_fits_eighty_columns(scenario: str) -> None:
    run = noack.simulate(noack.load(scenario, {"horizon_s": 1.0}))
    rows = short_numbers(run.summary)
    assert max(len(name) for name, _ in rows) + max(len(value) for _, value in rows) <= 73
    # There is no other value to compare with.
    assert "ideal loop" not in verdict(run.summary)[2].text
