"""Creates a run's recording for the viewer, during the run or from its record."""

import errno
import os
from pathlib import Path
from shutil import disk_usage

from cosim.output.viewer.live_viewer import LiveView
from cosim.output.viewer.pictures.network_picture import LEG_S, NetworkDiagram
from cosim.output.viewer.pictures.picture_choice import picture_of
from cosim.output.viewer.recording import RunView
from cosim.output.viewer.recording_file import ViewError
from cosim.output.viewer.table_feed import ViewFeed
from cosim.record.decimate import is_long
from cosim.record.environment import Kind
from cosim.record.run_directory import RECORDING_FILE
from cosim.record.run_record import RunRecord
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.protocol.topology import LOOP_ROLES

_INDEXED_S = 120.0
"""Recordings of runs up to this wall time get an index, which needs memory."""

_SPARE_BYTES = 4 * 2**20
"""Free space without which no recording is written from a record."""


def open_view(
    scenario: Scenario,
    run_dir: Path,
    run_id: int,
    live: LiveView | None,
    kind: Kind = "live",
    *,
    at_once: bool = False,
) -> RunView:
    """Create the recording of a run; it is written afterwards, at once or during the run."""
    loop = loop_of(scenario)
    return RunView(
        run_dir / RECORDING_FILE,
        run_id=f"{run_id:016x}",
        title=f"{scenario.name} ({scenario.mode})",
        about=about(scenario, kind),
        state_names=loop.state_names,
        input_names=loop.input_names,
        processes=LOOP_ROLES if kind == "live" else (),
        horizon_s=scenario.horizon_s,
        picture=picture_of(scenario),
        diagram=None
        if at_once and is_long(scenario)
        else NetworkDiagram(*scenario.network.flows[1:]),
        live=live,
        clocks=scenario.clocks is not None and kind == "live",
        indexed=at_once or scenario.horizon_s <= _INDEXED_S * scenario.speed,
    )


def write_view(record: RunRecord, run_dir: Path, run_id: int) -> None:
    """Write a run's recording from its record; that of a long run shows extremes only."""
    scenario = record.scenario
    columns = record.slice_columns if is_long(scenario) else None
    require_space(run_dir)
    with open_view(scenario, run_dir, run_id, None, record.kind, at_once=True) as view:
        feed_record(ViewFeed(scenario, view, columns), record, run_dir)


def feed_record(feed: ViewFeed, record: RunRecord, run_dir: Path) -> None:
    """Pass a record to the view, part by part, while there is space in its folder.

    Raises:
        ViewError: there is no more space, or the recording cannot be written.
    """
    for i, part in enumerate(record.slices()):
        require_space(run_dir)
        if i:
            feed.advance()
        for table, rows in part.items():
            feed.add(table, rows)
    for notice in record.notices:
        feed.log(notice)
    feed.advance(final=True)


def require_space(run_dir: Path) -> None:
    """Raise ViewError if the disk is nearly full: rerun may wait forever after a failed write."""
    if disk_usage(run_dir).free < _SPARE_BYTES:
        path = run_dir / RECORDING_FILE
        raise ViewError(f"{path}: cannot write the recording: {os.strerror(errno.ENOSPC)}")


def about(scenario: Scenario, kind: Kind = "live") -> str:
    """Return the viewer's text about a run, in Markdown."""
    network = scenario.network
    late = {
        "live": "* **Lateness**: wall time between a deadline and the process's action.",
        "simulated": "* The run was **simulated** in virtual time: no deadline was missed.",
    }[kind]
    hold = "a model of the plant" if scenario.mode == "model" else "a zero-order hold"
    return f"""# {scenario.name}

{scenario.description}

Sensor and controller run **{hold}** between updates. The sensor transmits when
{scenario.trigger.description}.
The network ({network.loss.model.replace("_", "-")} loss) guarantees:
{network.guarantee.meaning}.
{scenario.protocol.summary}

* A finished run opens at its largest ‖e_c‖. **Colours** explains the colours.
* **Picture**: the plant (solid), the sensor's model (outline) and the controller's model (dashed
  outline). Play the run to animate it.
* **Packets**: each update in flight. A lost one falls; a forced delivery is a diamond. A flight
  takes microseconds but is animated as {LEG_S:g} s per hop, so x_c jumps before the dot arrives.
* **States**: the plant's x, the sensor's model x_s (reset {scenario.protocol.reset}), the
  controller's model x_c (reset by each delivery). Where x_c differs from the other two, packets
  were lost.
* **Intervals**: time since the previous transmission, and since the previous delivery.
* **Errors**: e_s = x_s − x with its threshold; e_c = x_c − x with two bounds, one from identity
  (I1) and the certified one. No process of the loop can measure e_c. The certified bound holds
  while no process is later than the certificate allows (see the claims of the summary).
{late}
"""
