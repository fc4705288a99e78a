"""The scenario: everything that defines a run, validated into frozen objects.

A scenario file is TOML; every key is documented here and in the exported JSON Schema. Unknown keys
are errors. :mod:`noack.resolve` turns a scenario into one in which nothing is left to chance.
"""

import json
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, TypeAdapter, ValidationError, model_validator

from noack.clock import NS_PER_S
from noack.disturbances import AnyDisturbance, require_disturbances, variance_at
from noack.errors import CallerError
from noack.impairments import (
    Impairment,
    LinkSettings,
    Loss,
    Lossless,
    LossOf,
    Mansd,
    Trace,
    require_scores,
)
from noack.knobs import LOSS, MANSD, put_settings, require_knobs
from noack.linear import Matrix
from noack.matrices import (
    Row,
    Rows,
    require_length,
    require_non_negative,
    require_shape,
    shape,
)
from noack.models import MODEL_PARAMETERS, NAMED_MODELS
from noack.observers import AnyObserver, Kalman, Measurement
from noack.section import Section, Seed
from noack.setpoint import input_at
from noack.systems import AnySystem, Linear
from noack.triggers import AnyTrigger, Decaying, require_on_grid
from noack.wire import MAX_DIMENSION, Flow

Port = Annotated[int, Field(ge=0, le=65535)]
RateHz = Annotated[FiniteFloat, Field(gt=0, le=100_000)]
_LEAST_RATE_HZ = 1e-9
"""Its period in nanoseconds fits into 64 bits."""
_TIMEOUT_PERIODS = 5
_WATCHDOG_PERIODS = 50
MOST_CHANGES = 256
"""In a run."""


def period_ns(rate_hz: float) -> int:
    """The period of a rate in nanoseconds; rates are validated to have a whole one."""
    return round(NS_PER_S / rate_hz)


def _require_whole_period(rate_hz: float, key: str) -> None:
    if rate_hz < _LEAST_RATE_HZ:
        raise ValueError(f"{key}: must be at least {_LEAST_RATE_HZ:g}")
    whole_ns = period_ns(rate_hz)
    if whole_ns < 1 or abs(NS_PER_S / whole_ns - rate_hz) > 1e-12 * rate_hz:
        raise ValueError(
            f"{key}: the period must be a whole number of nanoseconds; "
            f"the nearest such rate is {NS_PER_S / max(whole_ns, 1)!r}"
        )


class Model(Section):
    """What sensor and controller believe about the plant: Â, B̂, and the gain K of u = K x_c.

    Either ``name`` (with optional ``parameters``), or the matrices ``A``, ``B`` and ``gain``, or a
    ``file`` of them.
    """

    name: Literal["lane_following", "single_track_lane", "double_integrator"] | None = None
    """A named model; see noack/models.py."""
    parameters: dict[str, FiniteFloat] = Field({})
    """Parameters of the named model that differ from its defaults."""
    A: Rows | None = None
    """Â by rows, n x n, per second."""
    B: Rows | None = None
    """B̂ by rows, n x m."""
    gain: Rows | None = None
    """K by rows, m x n; a named model brings its own, and a file may."""
    file: str | None = None
    """An .npz or .mat file of A, B and, unless it stands here, the gain, named gain or K. Relative
    names begin at the scenario file; what the file says replaces it when it is loaded."""
    names: dict[Literal["A", "B", "gain"], str] | None = None
    """Names of the arrays in the file, where they are others."""
    state_names: tuple[str, ...] | None = None
    """Names of the n states, for plots."""
    input_names: tuple[str, ...] | None = None
    """Names of the m inputs, for plots."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _require_read(self)
        if self.name is not None:
            self._check_named(self.name)
        else:
            self._check_explicit()
        n, m = self.dimensions
        require_shape(self.gain, "gain", (m, n), "one row per input, one column per state")
        require_length(self.state_names, "state_names", n, "one name per state")
        require_length(self.input_names, "input_names", m, "one name per input")
        return self

    def _check_named(self, name: str) -> None:
        if self.A is not None or self.B is not None:
            raise ValueError("name: a named model has its own A and B; give one or the other")
        known = MODEL_PARAMETERS[name]
        for key in self.parameters:
            if key not in known:
                raise ValueError(
                    f"parameters.{key}: {name} has no such parameter; it has {', '.join(known)}"
                )
        named = NAMED_MODELS[name](self.parameters)
        if not all(np.isfinite(matrix).all() for matrix in (named.A, named.B, named.K)):
            raise ValueError("parameters: these give matrices with infinite entries")

    def _check_explicit(self) -> None:
        if self.parameters:
            raise ValueError("parameters: only a named model has parameters")
        if self.A is None or self.B is None or self.gain is None:
            missing = [k for k in ("A", "B", "gain") if getattr(self, k) is None]
            raise ValueError(
                f"{missing[0]}: give a model by name, or by the matrices A, B and gain, or by a "
                f"file of them (missing: {', '.join(missing)})"
            )
        n = len(self.A)
        require_shape(self.A, "A", (n, n), "the system matrix is square")
        require_shape(self.B, "B", (n, shape(self.B, "B")[1]), "one row per state")

    @property
    def dimensions(self) -> tuple[int, int]:
        """Number of states n and of inputs m."""
        if self.name is not None:
            n, m = NAMED_MODELS[self.name](self.parameters).B.shape
            return n, m
        return (len(self.B), len(self.B[0])) if self.B else (0, 0)

    @property
    def matrices(self) -> tuple[Matrix, Matrix]:
        """Â, (n, n), and B̂, (n, m)."""
        if self.name is not None:
            named = NAMED_MODELS[self.name](self.parameters)
            return named.A, named.B
        return np.array(self.A), np.array(self.B)


class Watchdog(Section):
    """What the plant does when no actuation has come for too long."""

    timeout_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """The newest actuation is too old when its model state is older than this, in simulated time;
    by default 50 periods of the controller."""
    policy: Literal["hold", "zero", "model"] = "hold"
    """hold: the plant goes on with the newest input; zero: with none; model: with that which the
    controller's model asks for, propagated from the newest actuation, which then carries x_c."""


class Plant(Section):
    """The true plant, unknown to sensor and controller, and how it is drawn."""

    system: AnySystem = Linear()
    """What it is: a table with ``kind``; a linear system unless given."""
    draw: Literal["nominal", "uniform", "vertex", "given"] = "nominal"
    """nominal: the model itself; uniform: each entry within its half-width; vertex: each entry at
    one end of its half-width; given: the matrices A and B below."""
    uncertainty_A: Rows | None = None
    """Half-widths of the uncertainty box around Â, n x n."""
    uncertainty_B: Rows | None = None
    """Half-widths of the uncertainty box around B̂, n x m."""
    A: Rows | None = None
    """The true A, n x n, for draw = "given"."""
    B: Rows | None = None
    """The true B, n x m, for draw = "given"."""
    file: str | None = None
    """An .npz or .mat file of the true A and B, as model.file is."""
    names: dict[Literal["A", "B"], str] | None = None
    """Names of the arrays in the file, where they are others."""
    initial_state: Row
    """x(0), n entries."""
    initial_state_halfwidth: Row | None = None
    """x(0) is drawn uniformly within these distances of initial_state; n entries."""
    rate_hz: RateHz = 500.0
    """Steps per second of simulated time."""
    measure_every: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """A measurement is sent every so many steps."""
    measurement: Measurement = Measurement()
    disturbances: tuple[AnyDisturbance, ...] = ()
    """What disturbs it, one added to the other."""
    watchdog: Watchdog = Watchdog()

    @model_validator(mode="after")
    def _check(self) -> Self:
        _require_whole_period(self.rate_hz, "rate_hz")
        _require_read(self)
        for key in ("A", "B"):
            matrix = getattr(self, key)
            if self.draw == "given" and matrix is None:
                raise ValueError(f'{key}: draw = "given" needs both matrices A and B')
            if self.draw != "given" and matrix is not None:
                raise ValueError(f'{key}: matrices are for draw = "given", not "{self.draw}"')
        if self.draw != "nominal" and not isinstance(self.system, Linear):
            raise ValueError(
                f'draw: "{self.draw}" is for linear plants; a {self.system.kind} is what it is'
            )
        box = (self.uncertainty_A or ()) + (self.uncertainty_B or ())
        if self.draw in ("uniform", "vertex") and not box:
            raise ValueError(
                f'uncertainty_A: draw = "{self.draw}" needs uncertainty_A or uncertainty_B'
            )
        for key in ("uncertainty_A", "uncertainty_B"):
            for row in getattr(self, key) or ():
                require_non_negative(row, key)
        require_non_negative(self.initial_state_halfwidth or (), "initial_state_halfwidth")
        return self


def _require_read(section: Model | Plant) -> None:
    if section.file is not None:
        raise ValueError("file: it is read where a scenario file is loaded; give matrices here")
    if section.names is not None:
        raise ValueError("names: they are of arrays in a file; give file, too")


class Controller(Section):
    """The controller's schedule, and what it steers to."""

    rate_hz: RateHz = 500.0
    """Control inputs per second of simulated time."""
    phase: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.5
    """Offset of its ticks from the plant's, in periods; half a period lets a fresh update act
    within the same period."""
    safe_input: Row | None = None
    """What the controller puts out while it knows no state, m entries; by default 0."""
    setpoint: Row | None = None
    """x_r, n entries: the state at which the loop is to rest; by default 0. It must be an
    equilibrium of the model, Âx_r + B̂u_r = 0; then u = K(x_c − x_r) + u_r."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _require_whole_period(self.rate_hz, "rate_hz")
        return self


class Acknowledgements(Section):
    """The way back from controller to sensor, of the acknowledgement baseline."""

    loss: Loss = Lossless()
    """What is lost of the acknowledgements."""
    mansd: Mansd | None = None
    """At most so many successive acknowledgements are lost; without it, any number."""
    impairments: tuple[Impairment, ...] = ()
    """What else happens to them, in this order, after the loss."""
    timeout_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """After a transmission, the sensor waits so long for its acknowledgement before it transmits
    again. By default five measurement periods, and the longest delay there and back."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_scores(self.impairments, self.loss)
        return self

    @property
    def link(self) -> LinkSettings:
        """The link from controller to sensor."""
        return LinkSettings(
            impairments=(LossOf(loss=self.loss), *self.impairments), mansd=self.mansd
        )


class Network(Section):
    """The lossy network between sensor and controller."""

    mansd: Mansd
    """M − 1, the maximum allowable number of successive dropouts; the paper's M = 5 is 4."""
    loss: Loss
    """What is lost, before the cap."""
    impairments: tuple[Impairment, ...] = ()
    """What else happens to the updates, in this order, after the loss."""
    limit: Annotated[int, Field(ge=1, le=1_000_000)] = 16_384
    """At most so many updates are delayed at once; more are dropped."""
    enforce_mansd: bool = True
    """false: the network ignores the cap, to see what a violated assumption does."""
    initial_sync: Literal["first_packet", "known_state"] = "first_packet"
    """How the paper's delivered t_0 is met. first_packet: the network passes the first packet of a
    flow. known_state: sensor and controller start from x(0)."""
    protocol: Literal["none", "ack"] = "none"
    """none: nothing is acknowledged, the paper's loop. ack: the baseline that it is compared with;
    the controller acknowledges each update, and x_s is reset only by an acknowledgement."""
    acknowledgements: Acknowledgements | None = None
    """The way back, for protocol = "ack"; by default nothing is lost on it. Of no effect where
    protocol = "none" is said."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_scores(self.impairments, self.loss)
        if self.acknowledgements is not None and "protocol" not in self.model_fields_set:
            raise ValueError(
                'acknowledgements: there are none unless protocol = "ack"; '
                'say protocol = "none" to go without'
            )
        return self

    @property
    def way_back(self) -> Acknowledgements:
        """The way back from controller to sensor, as given or by default."""
        return self.acknowledgements or Acknowledgements()

    @property
    def link(self) -> LinkSettings:
        """The link from sensor to controller."""
        return LinkSettings(
            impairments=(LossOf(loss=self.loss), *self.impairments),
            mansd=self.mansd if self.enforce_mansd else None,
            first_delivered=self.initial_sync == "first_packet",
            limit=self.limit,
        )


class Certificate(Section):
    """What the certificates of a run allow for, beyond the run's own schedule."""

    late_periods: Annotated[int, Field(ge=0, le=1000)] = 2
    """Updates and inputs may be late by so many steps of the plant."""


class Recovery(Section):
    """What becomes of a run when one of its processes dies."""

    rejoin_within_s: Annotated[FiniteFloat, Field(ge=0, le=86_400)] | None = None
    """The run goes on without its sensor, controller, network or recorder for so long (wall time),
    within which another may take its place; the launcher starts one by itself. 0: the run ends.
    By default 0 for what the launcher has started, and 60 for what people start. Without its plant
    there is no run."""


class ScheduledChange(Section):
    """Settings that are others from a time on, while the run goes on."""

    at_s: Annotated[FiniteFloat, Field(ge=0, le=1e7)]
    """Simulated time from which on they are in force."""
    set: Annotated[dict[str, Any], Field(min_length=1)]
    """The new values by their keys, e.g. "network.loss.probability" = 0.9: those of network.loss,
    network.mansd, controller.setpoint, and the numbers of the trigger."""

    @property
    def at_ns(self) -> int:
        """That time in nanoseconds."""
        return round(self.at_s * NS_PER_S)


class Seeds(Section):
    """Seeds of the named random streams; they are independent of each other."""

    plant: Seed = 0
    """Draw of the true plant from its uncertainty box."""
    initial_state: Seed = 0
    """Draw of x(0)."""
    loss: Seed = 0
    """The network's losses."""
    disturbance: Seed = 0
    """The plant's random disturbances."""
    noise: Seed = 0
    """The measurements' noise."""


class Ports(Section):
    """UDP ports on the loopback interface, and the control plane's TCP port; 0 takes a free one."""

    plant: Port = 0
    """Where the plant receives actuation."""
    sensor: Port = 0
    """Where the sensor receives measurements."""
    netem: Port = 0
    """Where the network takes the sensor's updates."""
    controller: Port = 0
    """Where the controller receives what survives."""
    control: Port = 0
    """TCP port of the zenoh control plane."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        taken: dict[int, str] = {}
        for key in ("plant", "sensor", "netem", "controller"):
            port = getattr(self, key)
            if port and port in taken:
                raise ValueError(
                    f"{key}: port {port} is already given to {taken[port]}; "
                    "take another, or 0 for any"
                )
            taken[port] = key
        return self


class Realtime(Section):
    """Real-time settings of the loop's processes; each is taken where the system permits it."""

    enabled: bool = True
    """Ask for SCHED_FIFO, locked memory, the shortest timer slack and no deep idle states."""
    fifo_priority: Annotated[int, Field(ge=1, le=98)] = 50
    """SCHED_FIFO priority."""
    pin_cores: bool = True
    """With SCHED_FIFO: neighbours in the loop run on different cores."""
    spin_us: Annotated[FiniteFloat, Field(ge=0, le=1000)] = 0.0
    """Busy-wait this long before each deadline; starves the others on a shared core."""


class Scenario(Section):
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
    model: Model
    plant: Plant
    trigger: AnyTrigger
    """When the sensor transmits."""
    observer: AnyObserver | None = None
    """How the sensor estimates the state from what is measured: a table with ``kind``; unless
    given, what is measured is the state."""
    network: Network
    controller: Controller = Controller()
    certificate: Certificate = Certificate()
    recovery: Recovery = Recovery()
    changes: Annotated[tuple[ScheduledChange, ...], Field(max_length=MOST_CHANGES)] = ()
    """What changes while the run goes on, in the order of time."""
    seeds: Seeds = Seeds()
    ports: Ports = Ports()
    realtime: Realtime = Realtime()

    @property
    def is_decaying(self) -> bool:
        """Whether the trigger is the paper's."""
        return isinstance(self.trigger, Decaying)

    @property
    def decaying(self) -> Decaying:
        """The trigger, if it is the paper's.

        Raises:
            CallerError: it is another.
        """
        if not isinstance(self.trigger, Decaying):
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
        require_knobs(settings, self.trigger)
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

    def _changed_network(self, content: Mapping[str, Any], *, of_loss: bool) -> Network:
        """The network with the loss and the cap that are given; of the rest, nothing changes."""
        update: dict[str, Any] = {}
        if "mansd" in content:
            update["mansd"] = _CHANGEABLE[MANSD].validate_json(json.dumps(content["mansd"]))
        if of_loss:
            update["loss"] = _CHANGEABLE[LOSS].validate_json(json.dumps(content["loss"]))
            if isinstance(update["loss"], Trace):
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
        require_knobs(settings, self.trigger)
        content = self.model_dump(mode="json", exclude_none=True, exclude={"changes"})
        put_settings(content, settings)
        return content

    @property
    def is_linear(self) -> bool:
        """Whether the plant is a linear system."""
        return isinstance(self.plant.system, Linear)

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
        if network.way_back.timeout_s is not None:
            return round(network.way_back.timeout_s * NS_PER_S)
        there_and_back_s = network.link.longest_delay_s + network.way_back.link.longest_delay_s
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
        if not isinstance(observer, Kalman):
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
    "controller": TypeAdapter(Controller),
}
"""What can be changed during a run, part by part."""


def _first(error: ValidationError) -> str:
    """The first mistake of a scenario that is validated while another one is."""
    mistake = error.errors(include_url=False)[0]
    place, message = ".".join(map(str, mistake["loc"])), mistake["msg"]
    return f"{place}: {message}" if place else message.removeprefix("Value error, ")
