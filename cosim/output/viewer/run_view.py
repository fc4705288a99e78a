"""The view of a run: opened as it begins, or written anew from its finished record."""

from pathlib import Path

from cosim.output.viewer.live_viewer import LiveView
from cosim.output.viewer.pictures.network_picture import LEG_S, NetworkDiagram
from cosim.output.viewer.pictures.picture_choice import picture_of
from cosim.output.viewer.recording import RunView
from cosim.output.viewer.table_feed import ViewFeed
from cosim.record.environment import Kind
from cosim.record.run_directory import RECORDING_FILE
from cosim.record.run_record import RunRecord
from noack.config.resolution import loop_of
from noack.config.scenario import Scenario
from noack.protocol.topology import LOOP_ROLES

_INDEXED_S = 120.0
"""Wall time of a run whose view has an index; that of a longer one would take too much memory."""


def open_view(
    scenario: Scenario,
    run_dir: Path,
    run_id: int,
    live: LiveView | None,
    kind: Kind = "live",
    *,
    at_once: bool = False,
) -> RunView:
    """Create the recording of a run, to be written at once or while the run goes on."""
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
        diagram=NetworkDiagram(acknowledged=scenario.is_acknowledged),
        live=live,
        indexed=at_once or scenario.horizon_s <= _INDEXED_S * scenario.speed,
    )


def write_view(record: RunRecord, run_dir: Path, run_id: int) -> None:
    """Write a run's recording from its finished record."""
    with open_view(record.scenario, run_dir, run_id, None, record.kind, at_once=True) as view:
        feed = ViewFeed(record.scenario, view)
        for table in record.tables:
            feed.add(table, record[table])
        for notice in record.notices:
            feed.log(notice)
        feed.advance(final=True)


def about(scenario: Scenario, kind: Kind = "live") -> str:
    """Markdown that says what the view shows."""
    network = scenario.network
    late = {
        "live": "* **Lateness**: wall time by which each process acted after its input was due.",
        "simulated": "* The run was **simulated**, in virtual time: nothing was ever late.",
    }[kind]
    protocol, x_s_is_reset = "Nothing is acknowledged.", "at every event"
    if scenario.is_acknowledged:
        protocol, x_s_is_reset = "**Updates are acknowledged.**", "when an update is acknowledged"
    hold = "a model of the plant" if scenario.mode == "model" else "a zero-order hold"
    return f"""# {scenario.name}

{scenario.description}

Sensor and controller run **{hold}** between updates. The sensor transmits when
{scenario.trigger.description}.
The network ({network.loss.model.replace("_", "-")} loss) drops at most
M − 1 = {network.mansd} packets in a row. {protocol}

* A finished run opens where ‖e_c‖ is largest. **Colours** names what each colour stands for.
* **The picture**: the plant, solid, and in outline where the sensor's model (whole line) and the
  controller's (dashes) believe it is. Play the run to see it move.
* **Packets**: each update on its way; what is lost falls, what was forced through is a diamond.
  A flight takes microseconds; it is drawn as {LEG_S:g} s a leg: x_c jumps before the dot arrives.
* **States**: the plant's x, the sensor's model x_s (reset {x_s_is_reset}), the controller's model
  x_c (reset only by what survives). Where x_c leaves the other two, packets were lost.
* **Intervals**: time since the last broadcast, and since the last reception.
* **Errors**: e_s = x_s − x against its threshold, and e_c = x_c − x, which nobody in the loop can
  measure, below what is known of it: the bound from identity (I1), and the certified one, which
  holds as long as nothing is later than the certificate allows (the summary's claims say so).
{late}
"""
