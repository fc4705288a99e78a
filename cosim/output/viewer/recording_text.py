"""The viewer's text about a loop, in Markdown."""

from cosim.output.viewer.pictures.network_picture import LEG_S
from cosim.record.run_directory import Kind
from noack.config.scenario import Scenario


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
