"""The keys of a scenario, and what follows from them: times, sizes of messages, covering theory.

:mod:`noack.scenario.scenario_checks` checks tables that depend on each other.
"""

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Any, Literal

from pydantic import Field, FiniteFloat

from netem.core.clock import NEVER_NS, NS_PER_S
from netem.core.errors import CallerError
from netem.core.number_format import as_html, as_text
from netem.core.periods import Period, exact_ns, period_of, whole_ns
from netem.core.settings_section import FolderName, ScenarioSection
from noack.controllers.linear_feedback import LinearFeedbackSettings
from noack.core.schedule import LoopSchedule, first_tick_ns
from noack.plants.linear import LinearSettings
from noack.protocol.roles import PROTOCOLS, LoopProtocol
from noack.protocol.wire_format import MAX_DIMENSION, Flow
from noack.scenario.outputs import LoopOutput, OutputSection, loop_outputs
from noack.scenario.run_sections import (
    CertificateSection,
    ClocksSection,
    LoopSection,
    PortsSection,
    RealtimeSection,
    ScheduledChange,
    SeedsSection,
)
from noack.scenario.sections import (
    AnyController,
    AnyObserver,
    AnyTrigger,
    ModelSection,
    NetworkSection,
    PlantSection,
)
from noack.scenario.symbols import ScenarioRoot
from noack.trigger_policies.decaying import DecayingSettings

MOST_CHANGES = 256  # largest number of scheduled changes in a run


class ScenarioTables(ScenarioRoot):
    """The keys of a scenario; :class:`noack.scenario.scenario.Scenario` checks them together."""

    name: FolderName
    """Names the run's directory: letters, digits, _ and -."""
    description: str = ""
    """The purpose of the scenario."""
    mode: Literal["model", "zoh"] = "model"
    """model: x_s and x_c follow Â + B̂K between updates; zoh: they hold the last update."""
    horizon_s: Annotated[FiniteFloat, Field(gt=0, le=1e7)]
    """Simulated length of the run."""
    speed: Annotated[FiniteFloat, Field(gt=0, le=1000)] = 1.0
    """Simulated time per wall time."""
    start_within_s: Annotated[FiniteFloat, Field(gt=0, le=86_400)] | None = None
    """The run ends if its processes are not ready within this wall time, which grows with the
    system's load, up to 20 times. By default 30, and unlimited if people start processes."""
    model: ModelSection
    plant: PlantSection
    trigger: AnyTrigger
    """When the sensor transmits."""
    observer: AnyObserver | None = None
    """The sensor's estimate of the state from the measurements: a table with ``kind``. Without it,
    the measurement must be the state."""
    network: NetworkSection
    controller: AnyController = LinearFeedbackSettings.model_construct()
    outputs: Annotated[tuple[OutputSection, ...], Field(min_length=1, max_length=MAX_DIMENSION)] | None = None
    """The outputs that bounds and figures are about, with units and allowed errors: by default the
    states."""
    certificate: CertificateSection = CertificateSection.model_construct()
    clocks: ClocksSection | None = None
    """The clocks of a run on several hosts."""
    changes: Annotated[tuple[ScheduledChange, ...], Field(max_length=MOST_CHANGES)] = ()
    """Changes of settings during the run, in the order of time."""
    loops: Annotated[tuple[LoopSection, ...], Field(min_length=1)] | None = None
    """The loops on the network, if there are several."""
    seeds: SeedsSection = SeedsSection.model_construct()
    ports: PortsSection = PortsSection.model_construct()
    realtime: RealtimeSection = RealtimeSection.model_construct()

    def loop_outputs(self) -> tuple[LoopOutput, ...]:
        """Return the outputs; raise ValueError, with the key, if a row does not fit.

        They have no allowed errors if only the controller's law knows what they are to follow.
        """
        model = self.named_model
        further = model.dimensions[0] - model.plant_states
        outputs = loop_outputs(self.outputs, model.state_names or (), model.state_units, further)
        has_target = self.controller.target is not None
        return outputs if has_target else tuple(output._replace(allowed=None) for output in outputs)

    @property
    def named_model(self) -> ModelSection:
        """The model, with names of its states and inputs, and with units where they are known."""
        return self.model.with_names(self.plant.system)

    @property
    def entry_names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """The names of the states and of the inputs."""
        model = self.named_model
        return model.state_names or (), model.input_names or ()

    @property
    def states(self) -> int:
        """Number of states of the model with its loads and the controller's states: an update has them."""
        return self.model.states + self.controller.states

    @property
    def between_updates(self) -> str:
        """The controller's behaviour between updates, in words."""
        words = "model-based" if self.mode == "model" else "zero-order hold"
        if self.controller.update_timeout_s is None:
            return words
        later = "the last input" if self.controller.timeout_input == "hold" else "the safe input"
        return f"{words} for {self.controller.update_timeout_s:g} s, then {later}"

    def _rows(self) -> list[tuple[str, str]]:
        n, m = self.states, self.model.dimensions[1]
        rows = [
            ("scenario", self.name + (f": {self.description}" if self.description else "")),
            ("mode", self.between_updates),
            ("plant", f"{self.plant.system.kind}, n = {n}, m = {m}, {self.plant.rate_hz:g} Hz"),
            ("trigger", _section_text(self.trigger, "policy")),
            (
                "network",
                f"{_section_text(self.network.loss, 'model')}; at most {self.network.mansd} lost in a row",
            ),
            ("horizon", f"{self.horizon_s:g} s"),
        ]
        if self.loops:
            loops = (
                section.name if section.count == 1 else f"{section.count} x {section.name}"
                for section in self.loops
            )
            rows.append(("loops", ", ".join(loops)))
        return rows

    def __str__(self) -> str:
        """The most important settings, in a few lines."""
        return as_text(self._rows())

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Show the same text in IPython."""
        printer.text(str(self))

    def _repr_html_(self) -> str:
        """Show the same as a table in notebooks."""
        return as_html(self._rows())

    @property
    def estimates_state(self) -> bool:
        """Whether the sensor has an observer: it is given, or the model has loads."""
        return self.observer is not None or self.model.load is not None

    @property
    def timing(self) -> "Timing":
        """Periods, phases and timeouts."""
        return Timing(self)

    @property
    def message_sizes(self) -> "MessageSizes":
        """The number of vector entries in its messages."""
        return MessageSizes(self)

    @property
    def coverage(self) -> "TheoryCoverage":
        """What theory and simulation ask of it."""
        return TheoryCoverage(self)

    @property
    def decaying(self) -> DecayingSettings:
        """The trigger, if it is the paper's; raise CallerError for another policy."""
        return self.require_decaying()

    def require_decaying(self) -> DecayingSettings:
        """Return the trigger, if it is the paper's; raise CallerError for another policy."""
        if not isinstance(self.trigger, DecayingSettings):
            raise CallerError(
                f'trigger.policy: needs the paper\'s trigger, "decaying"; '
                f'this scenario has "{self.trigger.policy}"'
            )
        return self.trigger

    @property
    def protocol(self) -> LoopProtocol:
        """The settings that depend on whether updates are acknowledged."""
        return PROTOCOLS[self.network.protocol]


def _section_text(section: ScenarioSection, kind: str) -> str:
    """Describe a section by its kind, and its values that differ from the defaults."""
    changed = section.model_dump(mode="json", exclude_defaults=True, exclude={kind})
    values = (f"{key} = {'…' if isinstance(value, dict | list) else value}" for key, value in changed.items())
    return ", ".join((getattr(section, kind), *values))


_TIMEOUT_PERIODS = 5
"""Periods of measurements, beyond the round trip, that the sensor waits for an acknowledgement."""
_WATCHDOG_PERIODS = 50
"""Periods of the controller after which actuations are missing."""


@dataclass(frozen=True)
class Timing:
    """The schedule of a loop: periods, phases and timeouts, in nanoseconds of simulated time.

    Machines use whole nanoseconds (``..._ns``). Theory needs the exact times where a period is none
    (``exact_...``, and a period's :attr:`~netem.core.periods.Period.exact`): 10⁹/30 ns of 30 Hz.
    """

    scenario: ScenarioTables

    @property
    def horizon_ns(self) -> int:
        """Length of the run."""
        return round(self.scenario.horizon_s * NS_PER_S)

    @property
    def plant_period(self) -> Period:
        """Period of the plant's steps."""
        return period_of(self.scenario.plant.rate_hz)

    @property
    def measurement_period(self) -> Period:
        """Time between measurements."""
        return self.plant_period.times(self.scenario.plant.measure_every)

    @property
    def controller_period(self) -> Period:
        """Period of the controller's ticks."""
        return period_of(self.scenario.controller.rate_hz)

    @property
    def has_whole_periods(self) -> bool:
        """Whether all periods are whole numbers of nanoseconds: if not, steps differ by 1 ns."""
        return self.schedule().is_whole

    @property
    def plant_period_ns(self) -> int:
        """Longest time between two steps of the plant."""
        return self.plant_period.longest_ns

    @property
    def measurement_period_ns(self) -> int:
        """Longest time between two measurements."""
        return self.measurement_period.longest_ns

    @property
    def controller_period_ns(self) -> int:
        """Longest time between two ticks of the controller."""
        return self.controller_period.longest_ns

    def schedule(
        self, late_periods: int = 0, network_delay_s: float = 0.0, input_gap_ns: int = 0
    ) -> LoopSchedule:
        """Return steps, measurements and ticks with what lateness, delays and lost inputs may add."""
        plant, controller = self.scenario.plant, self.scenario.controller
        return LoopSchedule(
            self.plant_period,
            plant.measure_every,
            self.controller_period,
            controller.phase,
            late_periods,
            network_delay_s,
            input_gap_ns,
            controller.predictions,
        )

    @property
    def last_step(self) -> int:
        """The number of the plant's last step."""
        return self.plant_period.last_until(self.horizon_ns)

    @property
    def controller_phase_ns(self) -> int:
        """Time of the controller's first tick."""
        return first_tick_ns(self.scenario.controller.phase, self.controller_period)

    @property
    def exact_controller_phase(self) -> Fraction:
        """The same time without rounding, if machines round periods."""
        return self.schedule().exact_phase

    def exact_time(self, seconds: float, used_ns: int) -> Fraction:
        """Return a time for which machines use ``used_ns``: without rounding, if they round periods."""
        return Fraction(used_ns) if self.has_whole_periods else exact_ns(seconds)

    @property
    def actuation_timeout_ns(self) -> int:
        """Age of the newest actuation at which the plant's watchdog acts."""
        timeout_s = self.scenario.plant.watchdog.timeout_s
        if timeout_s is not None:
            return math.ceil(exact_ns(timeout_s))  # of that age, it is not yet too old
        usual_ns = _WATCHDOG_PERIODS * self.controller_period_ns
        actuation = self.scenario.network.actuation
        if actuation is None:
            return max(usual_ns, self.predicted_ns)
        # Of the age of its last input, it is not yet too old.
        predicted_ns = math.ceil(self.scenario.controller.predictions * self.controller_period.exact)
        last_ns = predicted_ns + round(actuation.link.longest_delay_s * NS_PER_S)
        return max(usual_ns, last_ns) if self.scenario.plant.watchdog.policy == "hold" else last_ns

    @property
    def update_timeout_ns(self) -> int:
        """Age of the newest update from which on the controller does not use it."""
        timeout_s = self.scenario.controller.update_timeout_s
        return NEVER_NS if timeout_s is None else whole_ns(timeout_s)

    @property
    def actuation_gap_ns(self) -> int | None:
        """Time by which losses and delays may hold up the newest actuation; None: no bound."""
        if (actuation := self.scenario.network.actuation) is None:
            return 0
        if (burst := actuation.link.longest_burst) is None:
            return None
        delay_ns = math.ceil(actuation.link.longest_delay_s * NS_PER_S)
        return burst * self.controller_period_ns + delay_ns

    @property
    def predicted_ns(self) -> int:
        """Time for which an actuation has inputs."""
        return self.schedule().predicted_ns

    @property
    def missing_actuation_ns(self) -> int:
        """Age of the newest actuation from which the plant reports that actuations are missing.

        The loss of a few is expected where they cross the network.
        """
        if self.scenario.network.actuation is None:
            return self.actuation_timeout_ns
        return max(self.actuation_timeout_ns, _WATCHDOG_PERIODS * self.controller_period_ns)

    @property
    def acknowledgement_timeout_ns(self) -> int:
        """The time that the sensor waits for an acknowledgement before it transmits again."""
        network = self.scenario.network
        if network.reverse.timeout_s is not None:
            return whole_ns(network.reverse.timeout_s)
        round_trip_s = network.link.longest_delay_s + network.reverse.link.longest_delay_s
        return int(_TIMEOUT_PERIODS * self.measurement_period.exact) + round(round_trip_s * NS_PER_S)


@dataclass(frozen=True)
class MessageSizes:
    """Number of vector entries per message of a scenario, by flow."""

    scenario: ScenarioTables

    @property
    def outputs(self) -> int:
        """The number p of measured outputs."""
        return self.scenario.plant.measurement.outputs(self.scenario.model.dimensions[0])

    @property
    def inputs_reported(self) -> int:
        """Number of applied inputs in a measurement: m per plant step since the last measurement.

        Only an observer needs them; without an observer it is 0.
        """
        if not self.scenario.estimates_state:
            return 0
        return self.scenario.plant.measure_every * self.scenario.model.dimensions[1]

    @property
    def measurement_entries(self) -> int:
        """Number of entries of a measurement: y, or y and the applied inputs since the last one."""
        return self.outputs + self.inputs_reported

    @property
    def carries_model(self) -> bool:
        """Whether actuations carry the controller's model state."""
        return self.scenario.plant.watchdog.policy == "model"

    @property
    def actuation_entries(self) -> int:
        """Number of entries of an actuation: its inputs, with x_c if it carries the model state."""
        n, m = self.scenario.states, self.scenario.model.dimensions[1]
        return m * self.scenario.controller.predictions + n * self.carries_model

    def entries(self, flow: Flow) -> int:
        """Number of entries of a message of a flow."""
        return {
            Flow.MEASUREMENT: self.measurement_entries,
            Flow.UPDATE: self.scenario.states,
            Flow.ACTUATION: self.actuation_entries,
            Flow.ACKNOWLEDGEMENT: 0,
        }[flow]


@dataclass(frozen=True)
class TheoryCoverage:
    """What theory and simulation ask of a scenario; noack/theory/coverage.py has what they cover."""

    scenario: ScenarioTables

    @property
    def is_decaying(self) -> bool:
        """Whether the trigger is the paper's."""
        return isinstance(self.scenario.trigger, DecayingSettings)

    @property
    def is_linear(self) -> bool:
        """Whether the plant is a linear system."""
        return isinstance(self.scenario.plant.system, LinearSettings)

    @property
    def knows_state(self) -> bool:
        """Whether the sensor measures the state itself, without noise."""
        return not self.scenario.estimates_state and not self.scenario.plant.measurement.is_noisy

    @property
    def is_undisturbed(self) -> bool:
        """Whether nothing disturbs the plant, and the sensor measures x."""
        return self.knows_state and not self.scenario.plant.disturbances

    def require_constant(self) -> None:
        """Raise CallerError if the settings change."""
        if self.scenario.changes:
            raise CallerError(
                "changes: needs settings that stay the same during the run; "
                "leave changes out, or use --set changes=[]"
            )

    def require_unchanging(self) -> None:
        """Raise CallerError if the settings change, or the set point is not 0."""
        self.require_constant()
        if self.scenario.controller.reference is not None:
            raise CallerError("controller.reference: this needs x_r = 0; leave controller.reference out")
        if any(self.scenario.controller.setpoint or ()):
            raise CallerError(
                "controller.setpoint: this needs the set point 0; leave controller.setpoint out"
            )

    def require_direct_inputs(self) -> None:
        """Raise CallerError unless every actuation reaches the plant and carries one input."""
        direct = self.scenario.network.actuation is None
        if direct and self.scenario.controller.predictions == 1:
            return
        key = "controller.predictions" if direct else "network.actuation"
        raise CallerError(f"{key}: needs actuations that reach the plant at once and carry one input")
