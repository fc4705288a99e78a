"""The most important facts about a run, in a few lines."""

from collections import Counter
from typing import TYPE_CHECKING

from cosim.analysis.loops_summary import has_loops
from cosim.output.loops_tables import claims_line, network_rows

if TYPE_CHECKING:
    from cosim.api.runs import Run

_OF_NETWORK = 3


def run_facts(run: "Run") -> list[tuple[str, str]]:
    """Return what a run was, how it ended, and its results, as names and values."""
    found = run.summary
    ended = f"at {found['reached_s']:g} s of {found['horizon_s']:g} s: {run.reason}"
    return [
        ("run", f"{found['scenario']}, {_mode(run)}, {found['kind']}, M − 1 = {found['mansd']}"),
        ("ended", ended),
        *(_of_loops(run) if has_loops(found) else _of_one_loop(run)),
        ("directory", str(run.directory)),
    ]


def _mode(run: "Run") -> str:
    found = run.summary
    if has_loops(found):
        return f"{len(found['loops'])} loops"
    return "model-based" if found["mode"] == "model" else "zero-order hold"


def _of_loops(run: "Run") -> list[tuple[str, str]]:
    rows = network_rows(run.summary)[:_OF_NETWORK]
    return [*rows, ("claims", claims_line(run.summary).partition(": ")[2])]


def _of_one_loop(run: "Run") -> list[tuple[str, str]]:
    found = run.summary
    events = (
        f"{found['events']}; {found['deliveries']} received, {found['drops']} lost, "
        f"longest loss burst {found['longest_loss_burst']}"
    )
    norms = (found["initial_state_norm"], found["final_state_norm"])
    verdicts = Counter(claim["verdict"] for claim in run.claims)
    return [
        ("events", events),
        ("‖x‖", " → ".join("unknown" if norm is None else f"{norm:.3g}" for norm in norms)),
        ("claims", ", ".join(f"{n} {verdict}" for verdict, n in verdicts.items()) or "none"),
    ]
