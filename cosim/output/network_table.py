"""Tables of a run: its network, and its loops, the worst first."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cosim.analysis.summary_model import DeadlinesPart, LoopSummary, RunSummary
from cosim.output.run_tables import changes_in, longest_burst
from noack.core.errors import ExitStatus
from noack.core.number_format import duration, number, ratio

_MOST_LOOPS = 12
_MOST_REASONS = 3
HEADINGS = (
    "loop", "sent", "lost", "burst", "forced", "share, %", "delay, s", "‖e_c‖", "claims held",
)  # fmt: skip
CAPTION = (
    "burst: most consecutive losses; forced: delivered by the guarantee; share: of the "
    "forwarded bytes; delay and ‖e_c‖: largest"
)


def print_loops(console: Console, summary: RunSummary, *, verbose: bool = False) -> None:
    """Print the network and the loops; without ``verbose`` the worst only."""
    for line in void_lines(summary.loops):
        console.print(line, highlight=False, markup=False, soft_wrap=True)
    console.print(_network_table(summary))
    loops = sorted(summary.loops, key=badness, reverse=True)
    shown = loops if verbose else loops[:_MOST_LOOPS]
    if len(shown) == len(loops):
        shown = summary.loops
    table = Table(
        title=f"{len(loops)} loops" + (", the worst first" if len(shown) < len(loops) else ""),
        caption=CAPTION, box=SIMPLE_HEAD,
        collapse_padding=True, pad_edge=False,
    )  # fmt: skip
    rows = [loop_row(loop) for loop in shown]
    for place, heading in enumerate(HEADINGS):
        cells = [heading, *(row[place] for row in rows)]
        # Headings and claims may break between words; names and numbers have no spaces.
        least = max(len(word) for cell in cells for word in cell.split())
        table.add_column(heading, justify="right" if place else "left", min_width=least)
    for row in rows:
        table.add_row(*map(escape, row))
    console.print(table)
    if more := len(loops) - len(shown):
        console.print(f"and {more} more loops: --verbose shows all")


def void_lines(loops: Sequence[LoopSummary]) -> list[str]:
    """Return why claims are void, the most frequent reasons first, with the number of loops."""
    void = [{one.why for one in loop.claims if one.verdict == "void"} for loop in loops]
    reasons = Counter(why for whys in void for why in sorted(whys))
    lines = [
        f"void: {why}" + (f" ({count} loops)" if count > 1 else "")
        for why, count in reasons.most_common(_MOST_REASONS)
    ]
    if more := len(reasons) - len(lines):
        lines.append(f"and {more} more reasons: the summaries of the loops have them")
    return lines


def badness(loop: LoopSummary) -> tuple[Any, ...]:
    """Return a key that is larger for a worse loop."""
    claims, error = _verdicts(loop), loop.sup_e_c_norm
    return (
        loop.exit.status != ExitStatus.OK, claims["violated"], claims["void"],
        loop.longest_loss_burst, float("inf") if error is None else error,
    )  # fmt: skip


def _verdicts(loop: LoopSummary) -> Counter[str]:
    return Counter(str(claim.verdict) for claim in loop.claims)


def network_rows(summary: RunSummary) -> list[tuple[str, str]]:
    """Return the quantities of the network, and their values as text."""
    network, flying = summary.network, summary.network.in_flight
    sent, reached_s = network.datagrams, summary.reached_s or math.inf
    lost = sum(network.drops_by_cause.values())
    causes = "".join(
        f", {n} {cause.replace('_', ' ')}" for cause, n in network.drops_by_cause.items()
    )
    rows = [
        ("updates of all loops", f"{sent} ({sent / reached_s:.4g} /s)"),
        ("lost", f"{lost} ({ratio(lost, sent)}){causes}"),
        longest_burst(summary.mansd, summary.constraints, network.longest_loss_burst),
        ("forced by the guarantee", str(network.forced_deliveries)),
        ("in the network: mean, max", f"{flying.mean:.3g}, {flying.max} datagrams"),
    ]
    if network.rate_bps is not None and network.utilisation is not None:
        used = f"{100 * network.utilisation:.3g} % of {network.rate_bps:,} bit/s"
        rows.append(("link used", used.replace(",", " ")))
    loops = summary.loops
    if flows := [one.actuations for one in loops if one.actuations is not None]:
        sent, lost = (sum(getattr(one, key) for one in flows) for key in ("sent", "lost"))
        rows.append(("actuations of all loops", f"{sent} ({sent / reached_s:.4g} /s)"))
        burst = max(one.longest_loss_burst for one in flows)
        rows.append(("  lost, longest loss burst", f"{lost} ({ratio(lost, sent)}), {burst}"))
    if trips := [one.watchdog.trips for one in loops if one.watchdog.trips]:
        rows.append(("watchdog acted", f"{sum(trips)} times, in {len(trips)} loops"))
    if deadlines := summary.deadlines:
        rows.append(("deadlines missed", _missed(deadlines)))
        worst = max(deadlines, key=lambda role: deadlines[role].max_us or 0.0)
        latest_s = 1e-6 * (deadlines[worst].max_us or 0.0)
        rows.append(("  largest lateness", f"{duration(latest_s)} ({worst})"))
    if (replay := network.replay) is not None:
        exact = {True: "bit-exact", False: "differs", None: "not possible"}[replay.bit_exact]
        rows.append(("replay of the network", exact))
        count = sum(one.replay is not None and one.replay.bit_exact is True for one in loops)
        rows.append(("replay of the loops", f"bit-exact: {count} of {len(loops)}"))
        missing, lost = (
            sum(getattr(one, key) for one in loops)
            for key in ("missing_samples", "unintended_losses")
        )
        rows.append(("missing samples, unintended losses", f"{missing}, {lost}"))
    return [*rows, *changes_in(summary.changes)]


def _missed(deadlines: Mapping[str, DeadlinesPart]) -> str:
    missed = [
        f"{role} {one.late_steps} of {one.steps}"
        for role, one in deadlines.items()
        if one.late_steps
    ]
    return ", ".join(missed) or "none"


def _network_table(summary: RunSummary) -> Table:
    kind = "" if summary.kind == "live" else f", {summary.kind}"
    further = "".join(f", {one}" for one in summary.constraints)
    table = Table(
        title=escape(f"network of {summary.scenario}, M − 1 = {summary.mansd}{further}{kind}")
    )
    table.add_column("quantity")
    table.add_column("value", justify="right")
    for row in network_rows(summary):
        table.add_row(*map(escape, row))
    return table


def loop_row(loop: LoopSummary) -> tuple[str, ...]:
    """Return what the table of the loops says of one, under ``HEADINGS``."""
    claims = _verdicts(loop)
    held = f"{claims['held']} of {sum(claims.values())}"
    worse = [f"{claims['violated']} violated"] if claims["violated"] else []
    if loop.exit.status == ExitStatus.FAILED:
        worse = ["failed"]
    return (
        loop.name, str(loop.events), str(loop.drops),
        str(loop.longest_loss_burst), str(loop.forced_deliveries),
        number(100 * (loop.link_share or 0.0)), number(loop.delay_max_s),
        number(loop.sup_e_c_norm), ", ".join([held, *worse]),
    )  # fmt: skip
