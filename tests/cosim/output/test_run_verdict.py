"""The end of a run: three lines, one table that fits, and no warning without a cause."""

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

import noack
from cosim.analysis.run_summary import Outcome
from cosim.analysis.summary_model import FidelityPart
from cosim.live.finalize import reopen
from cosim.output.run_tables import short_numbers
from cosim.output.run_verdict import print_outcome, remarks, verdict
from tests.cosim.summaries import with_values

RED = "\x1b[1;31m"


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The paper's example, completed without problems."""
    run = noack.simulate("lane_following", runs=tmp_path_factory.mktemp("runs"))
    return reopen(run.directory)


def printed(outcome: Outcome, *, verbose: bool = False, **changed: Any) -> str:
    """The output on a terminal of 80 columns, colours included."""
    file = io.StringIO()
    console = Console(file=file, width=80, force_terminal=True, color_system="standard")
    print_outcome(
        console, replace(outcome, summary=with_values(outcome.summary, **changed)), verbose=verbose
    )
    return file.getvalue()


def claim(verdict: str, why: str = "", what: str = "a") -> dict[str, Any]:
    return {"what": what, "source": "b", "bound": "c", "ratio": 1.0, "since_s": 1.0, "why": why,
            "verdict": verdict, "certified": 1.0, "observed": 1.0, "from_s": 0.0,
            "until_s": None}  # fmt: skip


def test_a_completed_run_prints_a_verdict_a_table_and_where_to_find_more(outcome: Outcome) -> None:
    summary = outcome.summary
    lines = [line.text for line in verdict(summary)]
    (loop,) = summary.loops
    assert isinstance(loop.fidelity, FidelityPart)
    claims = len(loop.claims)
    assert lines == [
        "completed 20 s",
        f"{loop.events} transmissions (ideal loop: {loop.fidelity.events_ideal}), "
        f"{loop.deliveries} delivered",
        f"claims: {claims} of {claims} held",
    ]
    text = printed(outcome)
    assert RED not in text
    assert "violated" not in text
    assert len(text.splitlines()) <= 25
    *_, last = text.splitlines()
    assert "--verbose" in last
    assert str(outcome.run_dir) in last
    assert list(remarks(summary)) == []


@pytest.mark.parametrize(
    ("status", "reason", "message"),
    [
        (0, "horizon", "completed 20 s"),
        (1, "sensor died", "failed after 20 s of 20 s: sensor died"),
        (130, "SIGINT", "stopped after 20 s of 20 s: SIGINT"),
        (0, "horizon; rows are missing", "completed 20 s: horizon; rows are missing"),
    ],
)  # fmt: skip
def test_the_first_line_states_how_the_run_ended(
    outcome: Outcome, status: int, reason: str, message: str
) -> None:
    first, *_ = verdict(with_values(outcome.summary, exit={"status": status, "reason": reason}))
    assert first.text == message
    assert (first.style == "bold red") == (status == 1)


def test_claims_that_did_not_hold_are_counted_with_a_reason(outcome: Outcome) -> None:
    claims = [claim("held"), claim("void", "late"), claim("not applicable", "ideal")]
    line = verdict(with_values(outcome.summary, claims=claims))[2]
    assert line.text == "claims: 1 of 3 held, 1 void (late), 1 not applicable (a: ideal)"
    worse = verdict(with_values(outcome.summary, claims=[*claims, claim("violated", what="b")]))[2]
    assert worse.text.startswith("claims: 1 of 4 held, 1 violated (b), 1 void (late)")
    assert worse.style == "bold red"
    many = [claim("not applicable", "ideal", name) for name in "abcde"]
    line = verdict(with_values(outcome.summary, claims=many))[2]
    assert line.text == "claims: 0 of 5 held, 5 not applicable (a; b; c; 2 more: ideal)"
    assert verdict(with_values(outcome.summary, claims=[]))[2].text == "claims: none"


def test_a_broken_guarantee_is_shown_as_an_error(outcome: Outcome) -> None:
    broken = {
        "t_s": 2.5,
        "process": "controller",
        "cause": "dropouts",
        "what": "MANSD violated: 6 lost",
    }
    text = printed(outcome, assumption_violations=[broken] * 7)
    assert text.count("assumption violated at t = 2.500 s (reported by controller): MANSD") == 5
    assert "2 more violations of this kind" in text
    assert RED in text


def test_an_assumption_that_a_scenario_violates_is_a_warning(tmp_path: Path) -> None:
    trigger = {"policy": "absolute", "delta": 0.02}
    run = noack.simulate(noack.load("double_integrator", {"trigger": trigger}), runs=tmp_path)
    assert "warning:" in (text := printed(reopen(run.directory)))
    assert "assumption violated: the trigger is" in text


def test_a_run_across_hosts_names_the_firewall_the_network_and_what_to_collect(
    outcome: Outcome,
) -> None:
    late = {"t_s": 1.0, "process": "recorder", "cause": "hold", "what": "an input was old"}
    found: dict[str, Any] = {
        "kind": "live", "unintended_losses": 3, "unintended_losses_by_leg": {"actuation": 3},
        "assumption_violations": [late], "replay": {"complete": False, "bit_exact": None},
    }  # fmt: skip

    def texts(clock_error_s: float | None) -> str:
        conditions = dict.fromkeys(("dropouts", "sampling_s", "delay_s", "hold_s", "start_s"))
        summary = with_values(
            outcome.summary, conditions=conditions | {"clock_error_s": clock_error_s}, **found
        )
        return "\n".join(one.text for one in remarks(summary))

    assert "lost elsewhere (kernel, or between the hosts; firewalls must pass" in texts(1e-4)
    assert "A host or the network between hosts was late" in texts(1e-4)
    assert "noack collect RUN_DIRECTORY HOST:FOLDER" in texts(1e-4)
    assert "lost elsewhere (kernel): 3 on actuation" in texts(None)
    assert "This machine was late" in texts(None)
    assert "collect" not in texts(None)


@pytest.mark.parametrize("scenario", ["four_tank", "lane_acknowledged"])
def test_the_table_fits_eighty_columns(scenario: str, tmp_path: Path) -> None:
    run = noack.simulate(noack.load(scenario, {"horizon_s": 1.0}), runs=tmp_path)
    rows = short_numbers(run.summary)
    assert max(len(name) for name, _ in rows) + max(len(value) for _, value in rows) <= 73
    # there is no other value to compare with
    assert "ideal loop" not in verdict(run.summary)[1].text


def test_a_live_run_has_latency_and_deadlines_in_its_table(outcome: Outcome) -> None:
    late = {"p50": 1.0, "p99": 2.0, "p999": 3.0, "max": 4.0, "steps": 100, "late_steps": 0}
    lateness = {"plant": late, "sensor": late | {"late_steps": 7}}
    latency = {"p50": 600.4, "p99": 900.0, "p999": 1.0, "max": 1.0, "updates": 3}
    rows = dict(
        short_numbers(with_values(outcome.summary, lateness_us=lateness, latency_us=latency))
    )
    assert rows["most deadlines missed"] == "sensor, 7 of 100"
    punctual = with_values(outcome.summary, lateness_us={"plant": late}, latency_us=latency)
    assert dict(short_numbers(punctual))["deadlines missed"] == "none"
    assert rows["sensor-to-controller latency p50 / p99"] == "600 / 900 µs"


def test_the_longest_burst_is_shown_with_the_limit_of_all_rules(outcome: Outcome) -> None:
    assert "longest loss burst (cap M − 1 = 4)" in dict(short_numbers(outcome.summary))
    change = {"number": 1, "t_s": 1.0, "settings": {"network.mansd": 9}, "what": ""}
    raised = with_values(outcome.summary, changes=[change | {"in_force_from_s": {}}])
    assert "longest loss burst (cap M − 1 = 9)" in dict(short_numbers(raised))
    limited = with_values(outcome.summary, constraints=["atmost 3 in 8"])
    assert "longest loss burst (at most 3 allowed)" in dict(short_numbers(limited))
