"""Our relay as the benchmarks start it, and what it says when it ends."""

import json
import re
import sys
from dataclasses import dataclass
from typing import NamedTuple

from benchmarks._report import MeasurementError

READY = re.compile(r"noack netem: 127\.0\.0\.1:(\d+) →")
"""What it says on standard error when it listens."""


@dataclass(frozen=True)
class Ours:
    """What is asked of our relay.

    Args:
        words: the impairments, in tc's words.
        realtime: ask for the real-time settings.
        segment: let neighbours of equal size leave as one message that the kernel cuts.
        engine: which engine; None for the relay's own choice.
        way_back: keep a return path for each client.
    """

    words: str
    realtime: bool = False
    segment: bool = False
    engine: str | None = None
    reverse: bool = False


class Totals(NamedTuple):
    """What the relay counted until it ended."""

    arrived: int
    forwarded: int
    longest_loss_burst: int
    lost_in_kernel: int


def command_of(ours: Ours, to: int) -> list[str]:
    """The command line that listens on any port of loopback and sends to the port ``to`` of it."""
    flags = {
        "--realtime": ours.realtime,
        "--segment": ours.segment,
        "--one-way": not ours.reverse,
    }
    engine = [] if ours.engine is None else ["--engine", ours.engine]
    return [
        *(sys.executable, "-m", "netem", "--listen", "127.0.0.1:0", "--to", f"127.0.0.1:{to}"),
        *ours.words.split(),
        *engine,
        *(flag for flag, wanted in flags.items() if wanted),
        "--json",
    ]


def totals_of(stdout: str) -> Totals:
    """Read what the relay printed with ``--json``.

    Raises:
        MeasurementError: it is not what was expected.
    """
    try:
        _, _, totals = stdout.partition("\n")  # the first line says that it is ready
        forward = json.loads(totals)["links"][0]["forward"]
        return Totals(
            arrived=forward["arrived"],
            forwarded=forward["forwarded"],
            longest_loss_burst=forward["longest_loss_burst"],
            lost_in_kernel=forward["unintended"]["lost_in_kernel"],
        )
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise MeasurementError(f"our relay's totals cannot be read: {error!r}") from None
