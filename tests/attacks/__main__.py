"""``python -m tests.attacks --number N``: send N hostile datagrams to each port of a run."""

import argparse
import sys
import tempfile
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

from noack.protocol.roles import LOOP_ROLES, RECEIVES, sender_to
from tests.attacks.attacked import CHECKS, Attacked, attack, may_forge_addresses
from tests.helpers.two_hosts import two_hosts


def counts_at(run: Attacked, role: str) -> Counter[str]:
    """Return the datagrams at a port: sent by kind, rejected by reason, and accepted."""
    channel, peer_sent = run.channel(role), run.channel(sender_to(role, RECEIVES[role]))["sent"]
    counts: Counter[str] = Counter()
    for (to, sender, kind), number in run.sent.items():
        if to == role:
            counts[f"sent, {sender}: {kind}"] += number
    counts.update({f"rejected: {reason}": n for reason, n in channel["rejected"].items()})
    counts["lost in the kernel, of the peer's"] = channel["kernel_drops"]
    counts["accepted, of the peer's"] = run.accepted(role)
    counts["accepted, others"] = run.accepted(role) - peer_sent
    return counts


def main() -> int:
    """Attack a run and print the table and each failed check; return 1 if a check failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--number", type=int, default=1_000_000, help="datagrams to each port")
    parser.add_argument("--rate", type=float, default=4000.0, help="of them a second")
    parser.add_argument("--hosts", action="store_true", help="across two network namespaces")
    options = parser.parse_args()
    forge = may_forge_addresses()
    minutes = options.number / options.rate / 60
    print(
        f"{options.number:,} datagrams to each of four ports, {minutes:.1f} minutes or more; "
        f"{'also' if forge else 'not'} with forged addresses ...",
        file=sys.stderr,
    )
    with tempfile.TemporaryDirectory(prefix="noack-attack-") as folder, ExitStack() as stack:
        hosts = stack.enter_context(two_hosts()) if options.hosts else None
        run = attack(Path(folder), options.number, options.rate, forge_addresses=forge, hosts=hosts)
        # The record is read from the folder.
        for role in LOOP_ROLES:
            print(f"hostile datagrams at the port of {role}")
            for label, number in counts_at(run, role).items():
                print(f"  {label}: {number:,}")
        held = sum(claim["verdict"] == "held" for claim in run.summary["loops"][0]["claims"])
        number = len(run.summary["loops"][0]["claims"])
        print(f"claims: {held} of {number} held, the others void with their reason")
        late = {role: run.summary["loops"][0]["lateness_us"][role]["p99"] for role in LOOP_ROLES}
        print("lateness p99:", ", ".join(f"{role} {us:.0f} µs" for role, us in late.items()))
        wrong = [f"{name}: {line}" for name, check in CHECKS.items() for line in check(run)]
    for line in wrong:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
