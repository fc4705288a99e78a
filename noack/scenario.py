"""The scenario: everything that defines a run, validated into frozen objects.

A scenario file is TOML; every key is documented here and in the exported JSON Schema. Unknown keys
are errors. :mod:`noack.resolve` turns a scenario into one in which nothing is left to chance.
"""

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from noack.clock import NS_PER_S
from noack.errors import CallerError
from noack.impairments import (
    Impairment,
    LinkSettings,
    Loss,
    Lossless,
    LossOf,
    Mansd,
    require_scores,
)
from noack.matrices import (
    Row,
    Rows,
    require_length,
    require_non_negative,
    require_shape,
    shape,
)
from noack.models import MODEL_PARAMETERS, NAMED_MODELS
from noack.section import Section, Seed
from noack.triggers import AnyTrigger, Decaying, require_on_grid

Port = Annotated[int, Field(ge=0, le=65535)]
RateHz = Annotated[FiniteFloat, Field(gt=0, le=100_000)]
_LEAST_RATE_HZ = 1e-9
"""Its period in nanoseconds fits into 64 bits."""
_TIMEOUT_PERIODS = 5


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

    Either ``name`` (with optional ``parameters``) or the matrices ``A``, ``B`` and ``gain``.
    """

    name: Literal["lane_following", "double_integrator"] | None = None
    """A named model; see noack/models.py."""
    parameters: dict[str, FiniteFloat] = Field({})
    """Parameters of the named model that differ from its defaults."""
    A: Rows | None = None
    """Â by rows, n x n, per second."""
    B: Rows | None = None
    """B̂ by rows, n x m."""
    gain: Rows | None = None
    """K by rows, m x n; a named model brings its own."""
    state_names: tuple[str, ...] | None = None
    """Names of the n states, for plots."""
    input_names: tuple[str, ...] | None = None
    """Names of the m inputs, for plots."""

    @model_validator(mode="after")
    def _check(self) -> Self:
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
                f"{missing[0]}: give a model by name, or by the matrices A, B and gain "
                f"(missing: {', '.join(missing)})"
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


class Plant(Section):
    """The true plant, unknown to sensor and controller, and how it is drawn."""

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
    initial_state: Row
    """x(0), n entries."""
    initial_state_halfwidth: Row | None = None
    """x(0) is drawn uniformly within these distances of initial_state; n entries."""
    rate_hz: RateHz = 500.0
    """Steps per second of simulated time."""
    measure_every: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """A measurement is sent every so many steps."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        _require_whole_period(self.rate_hz, "rate_hz")
        for key in ("A", "B"):
            matrix = getattr(self, key)
            if self.draw == "given" and matrix is None:
                raise ValueError(f'{key}: draw = "given" needs both matrices A and B')
            if self.draw != "given" and matrix is not None:
                raise ValueError(f'{key}: matrices are for draw = "given", not "{self.draw}"')
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


class Controller(Section):
    """The controller's schedule."""

    rate_hz: RateHz = 500.0
    """Control inputs per second of simulated time."""
    phase: Annotated[FiniteFloat, Field(ge=0, lt=1)] = 0.5
    """Offset of its ticks from the plant's, in periods; half a period lets a fresh update act
    within the same period."""

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


class Seeds(Section):
    """Seeds of the named random streams; they are independent of each other."""

    plant: Seed = 0
    """Draw of the true plant from its uncertainty box."""
    initial_state: Seed = 0
    """Draw of x(0)."""
    loss: Seed = 0
    """The network's losses."""


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
    network: Network
    controller: Controller = Controller()
    certificate: Certificate = Certificate()
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
        self.trigger.check(n, why)
        require_on_grid(self.trigger, self.measurement_period_ns)
        return self
