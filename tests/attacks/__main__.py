"""``python -m tests.attacks --number N``: send N hostile datagrams to each port of a run."""

import argparse
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Table

from noack.protocol.topology import LOOP_ROLES, SENDER
from noack.runtime.udp_sockets import SHED
from tests.attacks.attacked import Attacked, attack, may_forge_addresses
from tests.attacks.checks import CHECKS
from tests.attacks.kinds import FROM_ANYWHERE, FROM_THE_PEER
from tests.attacks.sender import PEER, STRANGER

_WIDTH = 120


def table_of(run: Attacked) -> Table:
    """Return a table by kind and port: datagrams sent and rejected."""
    table = Table("", "", *LOOP_ROLES, title="Hostile datagrams at each port")
    for role in LOOP_ROLES:
        table.columns[2 + LOOP_ROLES.index(role)].justify = "right"

    def row(what: str, which: str, number: Callable[[str], int | None]) -> None:
        found = [number(role) for role in LOOP_ROLES]
        table.add_row(what, which, *("-" if n is None else f"{n:,}" for n in found))

    for sender, kinds in ((STRANGER, FROM_ANYWHERE), (PEER, FROM_THE_PEER)):
        for kind in kinds:
            row(f"sent, {sender}", kind, lambda role, at=(sender, kind): _sent(run, role, *at))
    table.add_section()
    rejected = {role: run.channel(role)["rejected"] for role in LOOP_ROLES}
    reasons = sorted({reason for found in rejected.values() for reason in found} - {SHED})
    for reason in reasons:
        row("rejected", reason, lambda role, reason=reason: rejected[role].get(reason, 0))
    row("dropped by the kernel", SHED, lambda role: rejected[role].get(SHED, 0))
    table.add_section()
    row("lost in the kernel", "of the peer's", lambda role: run.channel(role)["lost_in_kernel"])
    row("accepted", "of the peer's", run.accepted)
    row("", "others", lambda role: run.accepted(role) - run.channel(SENDER[role])["sent"])
    return table


def _sent(run: Attacked, role: str, sender: str, kind: str) -> int | None:
    reasons = run.sent.get(role, {}).get(sender, {}).get(kind)
    return None if reasons is None else sum(reasons.values())


def main() -> int:
    """Attack a run and print the table and each failed check; return 1 if a check failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=1_000_000, help="datagrams to each port")
    parser.add_argument("--rate", type=float, default=4000.0, help="of them a second")
    options = parser.parse_args()
    forge = may_forge_addresses()
    minutes = options.number / options.rate / 60
    print(
        f"{options.number:,} datagrams to each of four ports, {minutes:.1f} minutes or more; "
        f"{'also' if forge else 'not'} with forged addresses ...",
        file=sys.stderr,
    )
    with tempfile.TemporaryDirectory(prefix="noack-attack-") as folder:
        run = attack(Path(folder), options.number, options.rate, forge_addresses=forge)
    console = Console()
    if not console.is_terminal:
        console.width = _WIDTH
    console.print(table_of(run))
    summary = run.summary
    held = sum(claim["verdict"] == "held" for claim in summary["claims"])
    print(f"claims: {held} of {len(summary['claims'])} held, the others void with their reason")
    late = {role: summary["lateness_us"][role]["p99"] for role in LOOP_ROLES}
    print("lateness p99:", ", ".join(f"{role} {us:.0f} µs" for role, us in late.items()))
    wrong = [f"{name}: {line}" for name, check in CHECKS.items() for line in check(run)]
    for line in wrong:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
