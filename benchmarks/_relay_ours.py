"""Our relay as the benchmarks start it, and its totals."""

import json
import re
import sys
from dataclasses import dataclass
from typing import NamedTuple

from benchmarks._report import MeasurementError

READY = re.compile(r"noack netem: 127\.0\.0\.1:(\d+) →")
"""Its line on standard error when it listens."""


@dataclass(frozen=True)
class Ours:
    """Settings of our relay.

    Args:
        words: the impairments, in tc's words.
        realtime: request real-time settings.
        segment: send successive datagrams of equal size as one message, which the kernel segments.
        way_back: keep a return path for each client.
    """

    words: str
    realtime: bool = False
    segment: bool = False
    reverse: bool = False


class Totals(NamedTuple):
    """The relay's final counts."""

    arrived: int
    forwarded: int
    longest_loss_burst: int
    lost_in_kernel: int


def command_of(ours: Ours, to: int) -> list[str]:
    """Return the command line that listens on any port of loopback and sends to its port ``to``."""
    flags = {
        "--realtime": ours.realtime,
        "--segment": ours.segment,
        "--one-way": not ours.reverse,
    }
    return [
        *(sys.executable, "-m", "netem", "--listen", "127.0.0.1:0", "--to", f"127.0.0.1:{to}"),
        *ours.words.split(),
        *(flag for flag, wanted in flags.items() if wanted),
        "--json",
    ]


def totals_of(stdout: str) -> Totals:
    """Read the output of the relay with ``--json``.

    Raises:
        MeasurementError: the output is not as expected.
    """
    try:
        _, _, totals = stdout.partition("\n")  # the first line reports that it is ready
        forward = json.loads(totals)["links"][0]["forward"]
        return Totals(
            arrived=forward["received"],
            forwarded=forward["forwarded"],
            longest_loss_burst=forward["longest_loss_burst"],
            lost_in_kernel=forward["unintended"]["lost_in_kernel"],
        )
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise MeasurementError(f"our relay's totals cannot be read: {error!r}") from None
