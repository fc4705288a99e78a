"""The arguments and options of ``noack measure``."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from cosim.cli import completion


class NetworkForm(StrEnum):
    """How a measured network is written."""

    TRACE = "trace"
    MODEL = "model"


class ClockRelation(StrEnum):
    """Whether sending and receiving times are comparable."""

    SAME = "same"
    DIFFERENT = "different"


Sources = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="FILE...|ADDRESS",
        help="A packet trace, the name of a shipped one, captures of both ends, a fate file, a "
        "run directory, delivery opportunities; or the address of a listener, to which a probe "
        "is sent.",
    ),
]
Listen = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Receive one probe there, e.g. 0.0.0.0:9100."),
]
Rate = Annotated[str, typer.Option(metavar="RATE", help="Datagrams of the probe.")]
Duration = Annotated[str, typer.Option("--for", metavar="TIME", help="Duration of the probe.")]
Size = Annotated[
    int, typer.Option(metavar="BYTES", help="Size of the probe's datagrams, at least 100.")
]
RoundTrip = Annotated[
    bool, typer.Option("--round-trip", help="The listener sends each datagram back.")
]
Silence = Annotated[
    str,
    typer.Option(
        metavar="TIME",
        help="Once a probe has begun, a listener ends after so long without a datagram. It waits "
        "for a probe until Ctrl-C.",
    ),
]
Save = Annotated[
    Path | None, typer.Option(help="Write the raw trace to this file while probing (.csv).")
]
Flow = Annotated[
    int, typer.Option(help="Flow of a capture or a fate file; 1 is the largest.", min=1)
]
SequenceAt = Annotated[
    str | None,
    typer.Option(
        metavar="OFFSET:BYTES[:little]",
        help="Where the payloads of a capture of the receiver's end have sequence numbers.",
    ),
]
Clocks = Annotated[
    ClockRelation | None,
    typer.Option(help="Whether both times of a file were read on the same clock."),
]
Deadline = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="Packets that take longer count as lost, e.g. 100ms."),
]
Shares = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SHARE",
        help="Share of loss bursts and packets for which M is given, e.g. 99%; repeatable.",
    ),
]
Windows = Annotated[
    list[int] | None,
    typer.Option(help="K of the (m, K) table; repeatable.", min=1, max=100_000_000),
]
Outage = Annotated[
    str | None,
    typer.Option(
        metavar="TIME",
        help="Loss bursts of this duration or more are outages; by default a test decides.",
    ),
]
ForScenario = Annotated[
    str | None,
    typer.Option(
        metavar="SCENARIO",
        help="Report for which share of the time its certificate would have been void.",
        autocompletion=completion.scenarios,
    ),
]
Page = Annotated[
    Path | None, typer.Option("--out", help="Write a page with tables and figures (.html).")
]
NetworkFile = Annotated[
    Path | None,
    typer.Option(help="Write a [network] section that reproduces the network (.toml)."),
]
Form = Annotated[
    NetworkForm,
    typer.Option("--as", help="Write the network as the trace itself, or as a fitted model."),
]
