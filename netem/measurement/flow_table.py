"""The measurements of several flows as a document: a row each, the worst first."""

from collections.abc import Iterator, Sequence
from pathlib import Path

from netem.core.errors import CallerError
from netem.core.number_format import NONE, counted, duration, percent
from netem.measurement.flow_comparison import FlowComparison, MeasuredFlow, compare_flows
from netem.measurement.network_measurement import MeasurementOptions
from netem.measurement.trace_sources import SourceOptions, read_flows
from netem.output.document import Document, Sentence, SentenceRole
from netem.output.result_tables import ResultTable

_HEADS = (
    "flow",
    "from → to, or target",
    "packets",
    "lost",
    "longest burst",
    "in a row, without outages",
    "delay p50 / p99",
    "jitter, max",
)


def flows_document(paths: Sequence[Path], reading: SourceOptions, options: MeasurementOptions) -> Document:
    """Return the table of all flows of captures, or of all targets of a log of fping.

    Raises:
        NoackError: one line; a file cannot be read, or an option is wrong.
    """
    name = " ".join(map(str, paths))
    compared = compare_flows(*read_flows(paths, reading), options)
    rows = [_row(flow) for flow in compared.measured]
    if not rows:
        reasons = "; ".join(f"flow {flow.number}: {flow.problem}" for flow in compared.not_measured[:1])
        raise CallerError(f"{name}: no flow can be measured; {reasons}")
    worst = compared.measured[0]
    text = f"flow {worst.number} is the worst of {len(rows)}: {percent(worst.loss_rate)} lost"
    return Document(
        title=name,
        kind="flows measured",
        data={
            "name": name,
            "flows": [flow.to_json() for flow in compared.measured],
            "not_measured": [flow._asdict() | {"trace": None} for flow in compared.not_measured],
            "left_out": compared.left_out,
        },
        blocks=[
            Sentence(text=text, role=SentenceRole.VERDICT, lead=f"{name}:"),
            ResultTable("flows", "flows, the worst first", _HEADS, rows),
            *(Sentence(text=line, role=SentenceRole.REMARK, is_prose=True) for line in _remarks(compared)),
        ],
    )


def _row(flow: MeasuredFlow) -> tuple[str, ...]:
    measurement, delays = flow.measurement, flow.measurement.delays
    shown = (
        " / ".join(duration(delays.quantiles_s[share]) for share in (0.5, 0.99)) if delays.received else NONE
    )
    return (
        str(flow.number),
        flow.name,
        str(len(measurement.trace)),
        f"{measurement.bursts.losses} ({percent(flow.loss_rate)})",
        str(measurement.bursts.longest),
        str(measurement.longest_loss_burst),
        shown,
        NONE if delays.jitter is None else duration(delays.jitter.largest_s),
    )


def _remarks(compared: FlowComparison) -> Iterator[str]:
    for flow in compared.not_measured:
        yield f"flow {flow.number} ({flow.name}) is not measured: {flow.problem}"
    if compared.left_out:
        yield f"left out: {counted(compared.left_out, 'smaller flow')}"
    yield "--flow N measures one of them with all tables"
