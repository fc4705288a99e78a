"""``noack measure``: losses, delays and the M of a real network."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from cosim.cli import command as cli
from cosim.cli import completion
from cosim.shipped_files import find_trace
from noack.core.errors import CallerError, ExitStatus

if TYPE_CHECKING:
    from cosim.measurement.network_measurement import MeasurementOptions


class NetworkForm(StrEnum):
    """How a measured network is written."""

    TRACE = "trace"
    MODEL = "model"


_TRACE = "rural_n8_10kmh"


@cli.command(cli.MEASURING, 10, [
    (f"noack measure {_TRACE} --deadline 100ms", "a recorded trace"),
    (f"noack measure {_TRACE} --deadline 100ms --out measured.html", "with a page of figures"),
    (f"noack measure {_TRACE} --for-scenario lane_following", "when its certificate would be void"),
    (f"noack measure {_TRACE} --write network.toml", "the network for a scenario file"),
])  # fmt: skip
def measure(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE...",
            help="A packet trace, the name of a shipped one, or files that belong together.",
        ),
    ],
    *,
    deadline: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Packets that take longer count as lost, e.g. 100ms."),
    ] = None,
    share: Annotated[
        list[float] | None,
        typer.Option(help="Share of loss bursts and packets for which M is given; repeatable."),
    ] = None,
    window: Annotated[
        list[int] | None,
        typer.Option(help="K of the (m, K) table; repeatable.", min=1, max=100_000_000),
    ] = None,
    outage: Annotated[
        str | None,
        typer.Option(
            metavar="TIME",
            help="Loss bursts of this duration or more are outages; by default a test decides.",
        ),
    ] = None,
    for_scenario: Annotated[
        str | None,
        typer.Option(
            metavar="SCENARIO",
            help="Report for which share of the time its certificate would have been void.",
            autocompletion=completion.scenarios,
        ),
    ] = None,
    settings: cli.SetOption = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Write a page with tables and figures (.html).")
    ] = None,
    write: Annotated[
        Path | None,
        typer.Option(help="Write a [network] section that reproduces the network (.toml)."),
    ] = None,
    form: Annotated[
        NetworkForm,
        typer.Option("--as", help="Write the network as the trace itself, or as a fitted model."),
    ] = NetworkForm.TRACE,
    json: cli.JsonOption = False,
) -> int:
    """Measure a network: losses, bursts, M, delays, outages, and models that fit."""
    from cosim.measurement.measurement_outputs import OutputRequest, report
    from cosim.measurement.network_measurement import Measurement
    from cosim.measurement.trace_sources import read_source

    options = _options(deadline, share, window, outage)
    scenario = None if for_scenario is None else cli.load_scenario(for_scenario, settings)
    request = OutputRequest(out, write, form.value, scenario)
    trace, notes = read_source([*map(find_trace, sources)])
    found = Measurement(trace, options, " ".join(sources), notes)
    document = report(found, request, None if json else Console())
    if json:
        cli.print_json(document)
    return ExitStatus.OK


def _options(
    deadline: str | None, shares: list[float] | None, window: list[int] | None, outage: str | None
) -> "MeasurementOptions":
    from cosim.measurement.burst_statistics import WINDOWS
    from cosim.measurement.network_measurement import QUANTILES, MeasurementOptions

    for share in shares or ():
        if not 0 < share <= 1:
            raise CallerError(f"--share {share:g}: expected a share above 0 up to 1, e.g. 0.99")
    return MeasurementOptions(
        deadline_s=_time_s("--deadline", deadline),
        quantiles=tuple(shares or QUANTILES),
        windows=tuple(sorted(set(window or WINDOWS))),
        outage_s=_time_s("--outage", outage),
    )


def _time_s(option: str, text: str | None) -> float | None:
    from noack.impairments.quantities import OWN_TIME_S

    if text is None:
        return None
    try:
        time_s = OWN_TIME_S.read(text)
        if not 0 < time_s < 1e9:
            raise ValueError
    except ValueError:
        raise CallerError(f"{option} {text}: expected {OWN_TIME_S.expected}") from None
    return time_s
