"""The scenario: everything that defines a run, validated into frozen objects.

A scenario file is TOML; every key is documented here and in the exported JSON Schema. Unknown keys
are errors. :mod:`noack.config.resolution` turns a scenario into one in which nothing is left to
chance.
"""

import json
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, TypeAdapter, ValidationError, model_validator

from noack.config.disturbances import require_disturbances, variance_at
from noack.config.observers import AnyObserver, KalmanSettings
from noack.config.plant_systems import LinearSettings
from noack.config.runtime_parameters import LOSS, MANSD, put_settings, require_runtime_parameters
from noack.config.sections.controller_section import ControllerSection
from noack.config.sections.model_section import ModelSection
from noack.config.sections.network_section import NetworkSection
from noack.config.sections.plant_section import PlantSection
from noack.config.sections.rates import period_ns
from noack.config.sections.run_sections import (
    CertificateSection,
    PortsSection,
    RealtimeSection,
    RecoverySection,
    ScheduledChange,
    SeedsSection,
)
from noack.config.setpoint import input_at
from noack.config.triggers import AnyTrigger, DecayingSettings, require_on_grid
from noack.core.clock import NS_PER_S
from noack.core.errors import CallerError
from noack.impairments.link_settings import Mansd, require_scores
from noack.impairments.loss_models import Loss
from noack.impairments.loss_models.trace import TraceLoss
from noack.protocol.wire_format import MAX_DIMENSION, Flow
from noack.settings.matrices import require_length, require_shape
from noack.settings.section import ScenarioSection

_TIMEOUT_PERIODS = 5
_WATCHDOG_PERIODS = 50
MOST_CHANGES = 256
"""In a run."""


class Scenario(ScenarioSection):
    """A run of the loop, completely described."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]{0,63}$")]
    """Names the run's directory: letters, digits, _ and -."""
    description: str = ""
    """What the scenario shows."""
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
    """How the sensor estimates the state from what is measured: a table with ``kind``; unless
    given, what is measured is the state."""
    network: NetworkSection
    controller: ControllerSection = ControllerSection()
    certificate: CertificateSection = CertificateSection()
    recovery: RecoverySection = RecoverySection()
    changes: Annotated[tuple[ScheduledChange, ...], Field(max_length=MOST_CHANGES)] = ()
    """What changes while the run goes on, in the order of time."""
    seeds: SeedsSection = SeedsSection()
    ports: PortsSection = PortsSection()
    realtime: RealtimeSection = RealtimeSection()

    def __str__(self) -> str:
        """What matters, in a few lines."""
        n, m = self.model.dimensions
        lines = {
            "scenario": self.name + (f": {self.description}" if self.description else ""),
            "mode": "model-based" if self.mode == "model" else "zero-order hold",
            "plant": f"{self.plant.system.kind}, n = {n}, m = {m}, {self.plant.rate_hz:g} Hz",
            "trigger": _said(self.trigger, "policy"),
            "network": f"{_said(self.network.loss, 'model')}; M − 1 = {self.network.mansd}",
            "horizon": f"{self.horizon_s:g} s",
        }
        return "\n".join(f"{name:<10} {text}" for name, text in lines.items())

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Show it so in IPython and notebooks."""
        printer.text(str(self))

    @property
    def is_decaying(self) -> bool:
        """Whether the trigger is the paper's."""
        return isinstance(self.trigger, DecayingSettings)

    @property
    def decaying(self) -> DecayingSettings:
        """The trigger, if it is the paper's.

        Raises:
            CallerError: it is another.
        """
        if not isinstance(self.trigger, DecayingSettings):
            raise CallerError(
                f'trigger.policy: this is for the paper\'s trigger, "decaying", only; '
                f'this scenario has "{self.trigger.policy}"'
            )
        return self.trigger

    @property
    def is_acknowledged(self) -> bool:
        """Whether this is the acknowledgement baseline, and not the paper's loop."""
        return self.network.protocol == "ack"

    def require_unacknowledged(self) -> None:
        """Check that nothing is acknowledged.

        Raises:
            CallerError: this is the acknowledgement baseline.
        """
        if self.is_acknowledged:
            raise CallerError(
                'network.protocol: this is for the loop without acknowledgements, "none", only; '
                'this scenario has "ack"'
            )

    def require_unchanging(self) -> None:
        """Check that the loop is to rest at 0, with the same settings to the end.

        Raises:
            CallerError: it is not.
        """
        if self.changes:
            raise CallerError(
                "changes: this is for runs whose settings stay as they are; "
                "leave them out, or say --set changes=[]"
            )
        if any(self.controller.setpoint or ()):
            raise CallerError("controller.setpoint: this is for loops that are to rest at 0 only")

    def changed(self, settings: Mapping[str, Any]) -> "Scenario":
        """Return the scenario with other settings, of those that may change during a run.

        Args:
            settings: values by keys.

        Raises:
            ValueError: one may not change, or the scenario would not be a valid one.
        """
        if self.is_acknowledged:
            raise ValueError('network.protocol: with "ack", nothing can be changed during a run')
        require_runtime_parameters(settings, self.trigger)
        # What is not touched is not looked at again: the processes of a run do this in their loop.
        touched = {key.split(".")[0] for key in settings}
        content: dict[str, Any] = {
            name: getattr(self, name).model_dump(mode="json", exclude_none=True)
            for name in touched - {"network"}
        }
        of_loss = any(key.startswith(LOSS) for key in settings)
        loss = self.network.loss.model_dump(mode="json", exclude_none=True) if of_loss else {}
        content["network"] = {"loss": loss}
        put_settings(content, settings)
        update: dict[str, Any] = {"changes": ()}
        for name in touched - {"network"}:
            update[name] = _CHANGEABLE[name].validate_json(json.dumps(content[name]))
        update["network"] = self._changed_network(content["network"], of_loss=of_loss)
        found = self.model_copy(update=update)
        n, m = self.model.dimensions
        if "trigger" in touched:
            found.trigger.check(n, f"the model has {n} states and {m} inputs")
            require_on_grid(found.trigger, self.measurement_period_ns)
        if "controller" in touched:
            found._check_setpoint(n)
        return found

    def _changed_network(self, content: Mapping[str, Any], *, of_loss: bool) -> NetworkSection:
        """The network with the loss and the cap that are given; of the rest, nothing changes."""
        update: dict[str, Any] = {}
        if "mansd" in content:
            update["mansd"] = _CHANGEABLE[MANSD].validate_json(json.dumps(content["mansd"]))
        if of_loss:
            update["loss"] = _CHANGEABLE[LOSS].validate_json(json.dumps(content["loss"]))
            if isinstance(update["loss"], TraceLoss):
                raise ValueError(
                    "network.loss.model: a trace is read before a run begins; give its losses as "
                    '{ model = "scripted", lost = [...] }'
                )
            require_scores(self.network.impairments, update["loss"])
        return self.network.model_copy(update=update)

    def changed_content(self, settings: Mapping[str, Any]) -> dict[str, Any]:
        """Return the content of the scenario with other settings, whether it is valid or not.

        Args:
            settings: values by keys, of those that may change during a run.

        Raises:
            ValueError: one may not.
        """
        require_runtime_parameters(settings, self.trigger)
        content = self.model_dump(mode="json", exclude_none=True, exclude={"changes"})
        put_settings(content, settings)
        return content

    @property
    def is_linear(self) -> bool:
        """Whether the plant is a linear system."""
        return isinstance(self.plant.system, LinearSettings)

    @property
    def is_certifiable(self) -> bool:
        """Whether the paper's theorems, and the certificates, can be of this loop."""
        return self.beyond_theory is None

    @property
    def beyond_theory(self) -> str | None:
        """Why neither the paper's theorems nor the certificates are of this loop; None if so."""
        if self.is_acknowledged:
            return 'network.protocol = "ack": updates are acknowledged'
        if not self.is_linear:
            return f'plant.system.kind = "{self.plant.system.kind}": the plant is not linear'
        if self.plant.disturbances:
            kinds = ", ".join(one.kind for one in self.plant.disturbances)
            return f"plant.disturbances ({kinds}): the plant is disturbed"
        if self.observer is not None:
            return f'observer.kind = "{self.observer.kind}": the state is estimated'
        if self.plant.measurement.is_noisy:
            return "plant.measurement: the state is measured with noise"
        if not self.is_decaying:
            return f'trigger.policy = "{self.trigger.policy}": not the paper\'s trigger'
        return None

    @property
    def knows_state(self) -> bool:
        """Whether the sensor measures the state itself, without noise."""
        return self.observer is None and not self.plant.measurement.is_noisy

    def require_exact(self) -> None:
        """Check that the plant is linear and undisturbed, and that the sensor measures its state.

        Raises:
            CallerError: one of these is not so.
        """
        self.require_linear()
        if self.plant.disturbances:
            raise CallerError(
                "plant.disturbances: this is for plants that nothing disturbs only; "
                "this scenario has " + ", ".join(f'"{one.kind}"' for one in self.plant.disturbances)
            )
        if self.observer is not None:
            raise CallerError(
                "observer: this is for sensors that measure the state itself only; "
                f'this scenario has "{self.observer.kind}"'
            )
        if self.plant.measurement.is_noisy:
            raise CallerError(
                "plant.measurement: this is for sensors that measure without noise only; "
                "this scenario has noise_std or noise_bound"
            )

    def require_linear(self) -> None:
        """Check that the plant is a linear system.

        Raises:
            CallerError: it is not.
        """
        if not self.is_linear:
            raise CallerError(
                'plant.system.kind: this is for linear plants, "linear", only; '
                f'this scenario has "{self.plant.system.kind}"'
            )

    @property
    def outputs(self) -> int:
        """How many outputs p are measured."""
        return self.plant.measurement.outputs(self.model.dimensions[0])

    @property
    def inputs_reported(self) -> int:
        """How many numbers of a measurement are the inputs since the one before.

        An observer needs them: m for every step of the plant.
        """
        observed = self.observer is not None
        return self.plant.measure_every * self.model.dimensions[1] if observed else 0

    @property
    def measurement_entries(self) -> int:
        """How many numbers a measurement carries: y, or [y; u of every step since]."""
        return self.outputs + self.inputs_reported

    @property
    def is_predictive(self) -> bool:
        """Whether actuations carry the controller's model state."""
        return self.plant.watchdog.policy == "model"

    @property
    def actuation_entries(self) -> int:
        """How many numbers an actuation carries: u, or [u; x_c]."""
        n, m = self.model.dimensions
        return n + m if self.is_predictive else m

    def entries(self, flow: Flow) -> int:
        """How many numbers a message of a flow carries."""
        return {
            Flow.MEASUREMENT: self.measurement_entries,
            Flow.UPDATE: self.model.dimensions[0],
            Flow.ACTUATION: self.actuation_entries,
            Flow.ACKNOWLEDGEMENT: 0,
        }[flow]

    @property
    def actuation_timeout_ns(self) -> int:
        """How old the newest actuation may be before the plant's watchdog acts."""
        if self.plant.watchdog.timeout_s is None:
            return _WATCHDOG_PERIODS * self.controller_period_ns
        return round(self.plant.watchdog.timeout_s * NS_PER_S)

    @property
    def acknowledgement_timeout_ns(self) -> int:
        """How long the sensor waits for an acknowledgement before it transmits again."""
        network = self.network
        if network.reverse.timeout_s is not None:
            return round(network.reverse.timeout_s * NS_PER_S)
        there_and_back_s = network.link.longest_delay_s + network.reverse.link.longest_delay_s
        return _TIMEOUT_PERIODS * self.measurement_period_ns + round(there_and_back_s * NS_PER_S)

    @property
    def horizon_ns(self) -> int:
        """Simulated length of the run in nanoseconds."""
        return round(self.horizon_s * NS_PER_S)

    @property
    def plant_period_ns(self) -> int:
        """Period of the plant's steps."""
        return period_ns(self.plant.rate_hz)

    @property
    def measurement_period_ns(self) -> int:
        """Time between measurements."""
        return self.plant_period_ns * self.plant.measure_every

    @property
    def controller_period_ns(self) -> int:
        """Period of the controller's ticks."""
        return period_ns(self.controller.rate_hz)

    @property
    def controller_phase_ns(self) -> int:
        """Time of the controller's first tick."""
        return round(self.controller.phase * self.controller_period_ns)

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.horizon_ns < self.plant_period_ns:
            raise ValueError(
                f"horizon_s: shorter than one plant step ({self.plant_period_ns / NS_PER_S} s)"
            )
        n, m = self.model.dimensions
        why = f"the model has {n} states and {m} inputs"
        plant = self.plant
        require_shape(plant.uncertainty_A, "plant.uncertainty_A", (n, n), why)
        require_shape(plant.uncertainty_B, "plant.uncertainty_B", (n, m), why)
        require_shape(plant.A, "plant.A", (n, n), why)
        require_shape(plant.B, "plant.B", (n, m), why)
        require_length(plant.initial_state, "plant.initial_state", n, "one per state")
        require_length(
            plant.initial_state_halfwidth, "plant.initial_state_halfwidth", n, "one per state"
        )
        require_length(self.controller.safe_input, "controller.safe_input", m, "one per input")
        self._check_setpoint(n)
        plant.system.check(n, m)
        require_disturbances(plant.disturbances, n, m, linear=self.is_linear)
        plant.measurement.check(n, why)
        self._check_observer()
        self._check_watchdog()
        self.trigger.check(n, why)
        require_on_grid(self.trigger, self.measurement_period_ns)
        self._check_changes()
        return self

    def _check_setpoint(self, n: int) -> None:
        key, setpoint = "controller.setpoint", self.controller.setpoint
        require_length(setpoint, key, n, "one per state")
        if setpoint is None:
            return
        if self.is_acknowledged:
            raise ValueError(f'{key}: not with network.protocol = "ack"')
        if self.is_predictive:
            raise ValueError(
                f'{key}: the plant knows of none; use plant.watchdog.policy = "hold" or "zero"'
            )
        try:
            input_at(*self.model.matrices, np.array(setpoint))
        except ValueError as error:
            raise ValueError(f"{key}: {error}") from None

    def _check_changes(self) -> None:
        for (place, one), (_, other) in pairwise(enumerate(self.changes)):
            if other.at_s < one.at_s:
                raise ValueError(f"changes.{place + 1}.at_s: before the change that it follows")
        scenario = self
        for place, change in enumerate(self.changes):
            if change.at_ns >= self.horizon_ns:
                raise ValueError(f"changes.{place}.at_s: the run ends at {self.horizon_s:g} s")
            try:
                scenario = scenario.changed(change.set)
            except ValidationError as error:
                raise ValueError(f"changes.{place}.set: {_first(error)}") from None
            except ValueError as error:
                raise ValueError(f"changes.{place}.set: {error}") from None

    def _check_observer(self) -> None:
        (n, m), plant, observer = self.model.dimensions, self.plant, self.observer
        if observer is None:
            if not plant.measurement.selects_all(n):
                raise ValueError(
                    "plant.measurement.C: without an [observer] the sensor has to measure every "
                    "state; give one, or no C"
                )
            return
        observer.check(n, m, self.outputs)
        if self.measurement_entries > MAX_DIMENSION:
            raise ValueError(
                "plant.measure_every: with an observer a measurement carries y and the inputs of "
                f"{plant.measure_every} steps, {self.outputs} + {self.inputs_reported} numbers; "
                f"at most {MAX_DIMENSION} fit"
            )
        if not isinstance(observer, KalmanSettings):
            return
        noise = plant.measurement.variance(n) if observer.noise_std is None else observer.noise_std
        if observer.R is None and not all(np.array(noise) > 0):
            raise ValueError(
                "observer.noise_std: every output needs some noise, for the filter to weigh it; "
                "give noise_std or R, or the measurement's own"
            )
        process, push = observer.process_std, observer.input_std
        at_state = variance_at("state", plant.disturbances, n) if process is None else process
        at_input = variance_at("input", plant.disturbances, m) if push is None else push
        if not any(at_state) and not any(at_input) and not np.any(observer.Q or 0):
            raise ValueError(
                "observer.process_std: without any process noise the filter stops listening; "
                "give process_std, input_std or Q, or random disturbances of the plant"
            )

    def _check_watchdog(self) -> None:
        if self.actuation_timeout_ns < self.controller_period_ns:
            raise ValueError(
                "plant.watchdog.timeout_s: shorter than a period of the controller "
                f"({self.controller_period_ns / NS_PER_S} s), by which an input is old anyhow"
            )
        if self.actuation_entries > MAX_DIMENSION:
            n, m = self.model.dimensions
            raise ValueError(
                'plant.watchdog.policy: with "model" an actuation carries u and x_c, '
                f"{m} + {n} numbers; at most {MAX_DIMENSION} fit"
            )


_CHANGEABLE: Mapping[str, TypeAdapter[Any]] = {
    LOSS: TypeAdapter(Loss),
    MANSD: TypeAdapter(Mansd),
    "trigger": TypeAdapter(AnyTrigger),
    "controller": TypeAdapter(ControllerSection),
}
"""What can be changed during a run, part by part."""


def _said(section: ScenarioSection, kind: str) -> str:
    """What a section is, and its values that are not the defaults."""
    given = section.model_dump(mode="json", exclude_defaults=True, exclude={kind})
    values = (
        f"{key} = {'…' if isinstance(value, dict | list) else value}"
        for key, value in given.items()
    )
    return ", ".join((getattr(section, kind), *values))


def _first(error: ValidationError) -> str:
    """The first mistake of a scenario that is validated while another one is."""
    mistake = error.errors(include_url=False)[0]
    place, message = ".".join(map(str, mistake["loc"])), mistake["msg"]
    return f"{place}: {message}" if place else message.removeprefix("Value error, ")
