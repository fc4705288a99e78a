"""The tables of a scenario that describe one loop: model, plant and network.

The kinds of controllers, disturbances, observers, plants and triggers are those that their folders
and installed extensions have (:func:`netem.core.settings_section.kinds_in`).
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from netem.core.settings_section import NonNegative, ScenarioSection, kinds_in, union_of
from netem.guarantee.loss_guarantee import LossGuarantee
from netem.impairments.constraints import join_guarantee, require_consistent
from netem.impairments.kinds import AnyImpairment
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import (
    USUAL_LIMIT,
    Constraints,
    LinkSettings,
    Mansd,
    require_order,
    require_scores,
)
from netem.impairments.loss_models import Loss
from netem.impairments.loss_models.lossless import NoLoss
from noack.controllers.controller_settings import ControllerSettings
from noack.core.cached_method import cached_method
from noack.core.linear_systems import Matrix, Vector, spectral_abscissa
from noack.disturbances.disturbance_settings import DisturbanceSettings, Place
from noack.observers.observer_settings import NoiseVariances, ObserverSettings
from noack.plants.linear import NAMED_MODELS, LinearSettings, NamedModel, parameters_of
from noack.plants.plant_settings import PlantSettings, name_and_unit, plain_name
from noack.protocol.record_tables import entry_names
from noack.protocol.wire_format import MAX_DIMENSION, Flow
from noack.scenario.symbols import ScenarioRoot
from noack.settings.values import (
    Bounds,
    Deviations,
    HalfWidthRows,
    HalfWidths,
    MatrixRows,
    Name,
    RateHz,
    Row,
    Unit,
    require_distinct,
    require_length,
    require_shape,
    shape,
)
from noack.trigger_policies.policy_settings import ModelMatrices, PolicySettings

# Settings classes by kind: a module in the folder, or of an extension, adds its kind.
CONTROLLERS = kinds_in("noack.controllers", ControllerSettings, group="noack.controllers")
DISTURBANCES = kinds_in("noack.disturbances", DisturbanceSettings, group="noack.disturbances")
OBSERVERS = kinds_in("noack.observers", ObserverSettings)
PLANTS = kinds_in("noack.plants", PlantSettings, group="noack.plants")
POLICIES = kinds_in("noack.trigger_policies", PolicySettings, "policy", group="noack.triggers")

if TYPE_CHECKING:
    AnyController = ControllerSettings
    AnyDisturbance = DisturbanceSettings
    AnyObserver = ObserverSettings
    AnyPlant = PlantSettings
    AnyTrigger = PolicySettings
else:
    AnyController = union_of(CONTROLLERS, default="linear")
    AnyDisturbance = union_of(DISTURBANCES)
    AnyObserver = union_of(OBSERVERS)
    AnyPlant = union_of(PLANTS, default="linear")
    AnyTrigger = union_of(POLICIES, "policy", default="decaying")
    for _settings in POLICIES.values():
        if not _settings.__pydantic_fields_complete__:  # a policy that combines others
            _settings.model_rebuild(_types_namespace={"AnyTrigger": AnyTrigger})


class ModelSection(ScenarioSection):
    """The model that sensor and controller use: Â, B̂, and the gain K of u = K x_c.

    It is given by ``name`` (with optional ``parameters``), by the matrices ``A``, ``B`` and
    ``gain``, or by a ``file`` with these matrices.
    """

    name: Literal["lane_following", "double_integrator"] | None = None
    """A named model; see noack/plants/linear.py."""
    parameters: dict[str, FiniteFloat] = Field({})
    """Parameters of the named model that differ from its defaults."""
    A: MatrixRows | None = None
    """Â by rows, n x n, per second."""
    B: MatrixRows | None = None
    """B̂ by rows, n x m."""
    gain: MatrixRows | None = None
    """K by rows, m x n; a named model has its own gain, and a file may have one."""
    file: str | None = None
    """An .npz or .mat file with A, B and, unless it is given here, the gain, named gain or K. A
    relative name is relative to the scenario file. Loading the scenario replaces the name by the
    matrices."""
    names: dict[Literal["A", "B", "gain"], str] | None = None
    """Names of the arrays in the file, if they differ from A, B and gain."""
    state_names: tuple[Name, ...] | None = None
    """Names of the n states, for outputs, tables and plots; by default those of a named model or of the
    plant's kind, if it has names."""
    state_units: tuple[Unit, ...] | None = None
    """Units of the n states, e.g. ["rad", "rad/s"]; "" for one without a unit. By default those of a
    named model or of the plant's kind."""
    input_names: tuple[Name, ...] | None = None
    """Names of the m inputs, for plots."""
    load: Literal["input"] | MatrixRows | None = None
    """Unknown constant loads, which the sensor's observer estimates and the input compensates.
    input: one at each input, ẋ = Âx + B̂(u + d); or E by rows, n x k, for ẋ = Âx + B̂u + E d."""
    hold: tuple[str, ...] | None = None
    """Names of the states that stay at 0, or at the set point, under a load that the input cannot
    cancel in every state; at most m."""
    integral: str | tuple[str, ...] | None = None
    """Outputs whose distances from the reference are integrated: the gain then has a column for each
    integral, after those of the states, and is that of a controller with these states of its own."""
    load_states: Annotated[int, Field(ge=0, le=MAX_DIMENSION)] = 0
    """Number of the last states that are loads: a resolved scenario has them in its matrices, in
    place of load."""
    controller_states: Annotated[int, Field(ge=0, le=MAX_DIMENSION)] = 0
    """Number of the last states that are the controller's own: a resolved scenario has them in its
    matrices, in place of those of controller.kind = "state_space"."""
    allow_unstable: bool = False
    """Accept a gain with which the model's closed loop Â + B̂K is unstable."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_no_file(self.file, self.names)
        if self.name is not None:
            self._check_named(self.name)
        else:
            self._check_explicit()
        n, m = self.dimensions
        require_shape(self.gain, "gain", (m, n), "one row per input, one column per state")
        require_length(self.state_names, "state_names", n, "one name per state")
        require_length(self.state_units, "state_units", n, "one unit per state")
        require_length(self.input_names, "input_names", m, "one name per input")
        require_distinct(self.state_names, "state_names")
        require_distinct(self.input_names, "input_names")
        self._check_loads(n)
        if self.integral is not None:  # loading a scenario replaces it
            raise ValueError("integral: it is read where a scenario file is loaded; give a controller here")
        return self

    def _check_loads(self, n: int) -> None:
        if self.load_states and (self.load is not None or self.load_states >= n):
            raise ValueError(
                "load_states: it is for resolved scenarios, whose matrices have the loads; give load"
            )
        if self.load_states + self.controller_states >= n:
            raise ValueError("controller_states: it is for resolved scenarios, whose matrices have them")
        if self.load is not None and self.load != "input":
            _, k = shape(self.load, "load")
            require_shape(self.load, "load", (n, k), "one row per state, one column per load")
        if self.hold is None:
            return
        if self.load is None:
            raise ValueError("hold: it names the states that stay at 0 under a load; give load, too")
        if self.state_names is None and self.name is None:
            raise ValueError("hold: it names states; give state_names, too")
        known = self.state_names or self.named.state_names
        for name in self.hold:
            if name not in known:
                raise ValueError(f"hold: no state is named {name}; they are {', '.join(known)}")

    def require_stable(self) -> None:
        """Raise ValueError unless the closed loop Â + B̂K is stable, or may be unstable.

        The message begins with the key. A controller with states of its own replaces this loop by another.
        """
        (A, B), uses_named_gain = self.matrices, self.gain is None  # a named model's own gain
        K = self.named.K if uses_named_gain else np.array(self.gain)
        n = self.dimensions[0] - self.load_states
        A, B, K = A[:n, :n], B[:n], K[:, :n]  # a constant load does not decay
        key = "model.parameters" if uses_named_gain else "model.gain"
        if not np.isfinite(_closed_loop(A, B, K)).all():
            raise ValueError(f"{key}: A + BK has infinite entries; check the units of A, B and K")
        if not self.allow_unstable and (reason := instability(A, B, K)) is not None:
            raise ValueError(
                f"{key}: {reason}; to run the unstable loop anyway, set model.allow_unstable = true"
            )

    def _check_named(self, name: str) -> None:
        if self.A is not None or self.B is not None:
            raise ValueError("name: a named model has its own A and B; give one or the other")
        names = parameters_of(name)
        for key in self.parameters:
            if key not in names:
                raise ValueError(f"parameters.{key}: {name} has no such parameter; it has {', '.join(names)}")
        if not all(np.isfinite(matrix).all() for matrix in self.named[:3]):
            raise ValueError("parameters: these give matrices with infinite entries")

    def _check_explicit(self) -> None:
        if self.parameters:
            raise ValueError("parameters: only a named model has parameters")
        if self.A is None or self.B is None or self.gain is None:
            missing = [k for k in ("A", "B", "gain") if getattr(self, k) is None]
            hint = "; noack gain FILE computes one" if missing == ["gain"] else ""
            raise ValueError(
                f"{missing[0]}: give a model by name, or by the matrices A, B and gain, or by a "
                f"file of them (missing: {', '.join(missing)}){hint}"
            )
        n = len(self.A)
        require_shape(self.A, "A", (n, n), "the system matrix is square")
        height, width = shape(self.B, "B")
        m = height if width == n != height else width  # it may be transposed
        require_shape(self.B, "B", (n, m), "one row per state")

    @property
    def named(self) -> NamedModel:
        """The model of its name, which must be given."""
        return NAMED_MODELS[self.name or ""](**self.parameters)

    @property
    def dimensions(self) -> tuple[int, int]:
        """Number of states n and of inputs m."""
        if self.name is not None:
            n, m = self.named.B.shape
            return n, m
        return (len(self.B), len(self.B[0])) if self.B else (0, 0)

    @property
    def plant_states(self) -> int:
        """Number of states that are neither loads nor the controller's."""
        return self.dimensions[0] - self.load_states - self.controller_states

    @property
    def followed_states(self) -> int:
        """Number of states that a reference has: all but the loads."""
        return self.dimensions[0] - self.load_states

    @property
    def loads(self) -> int:
        """Number of unknown constant loads."""
        if self.load is None:
            return self.load_states
        return self.dimensions[1] if self.load == "input" else len(self.load[0])

    @property
    def states(self) -> int:
        """Number of states of the model with its loads."""
        return self.plant_states + self.loads + self.controller_states

    @property
    def matrices(self) -> tuple[Matrix, Matrix]:
        """Â, (n, n), and B̂, (n, m)."""
        if self.name is not None:
            return self.named.A, self.named.B
        return np.array(self.A), np.array(self.B)

    def with_names(self, system: PlantSettings) -> Self:
        """Return the model with names of its states and inputs, and their units where they are known.

        Names and units that it does not give are those of the named model, or of the plant's kind.
        """
        n, m = self.dimensions
        named = None if self.name is None else self.named
        described, driven = system.states, system.inputs
        of_plant = tuple(map(plain_name, described)) if len(described) == self.plant_states == n else None
        units = tuple(name_and_unit(text)[1] for text in described) if of_plant else None
        of_inputs = tuple(map(plain_name, driven)) if len(driven) == m else None
        if named is not None:
            of_plant, units, of_inputs = named.state_names, named.state_units, named.input_names
        return self.model_copy(update={
            "state_names": self.state_names or of_plant or entry_names("x", n),
            "state_units": self.state_units or units,
            "input_names": self.input_names or of_inputs or entry_names("u", m),
        })  # fmt: skip

    @property
    def trigger_matrices(self) -> ModelMatrices:
        """Â, B̂ and K, on which a trigger's policy can depend."""
        K = self.named.K if self.gain is None else np.array(self.gain)
        return ModelMatrices(*self.matrices, K)


def require_no_file(file: str | None, names: object | None) -> None:
    """Raise ValueError if a section still names a file: loading a scenario replaces the name."""
    if file is not None:
        raise ValueError("file: it is read where a scenario file is loaded; give matrices here")
    if names is not None:
        raise ValueError("names: these are names of arrays in a file; give file, too")


def instability(A: Matrix, B: Matrix, K: Matrix) -> str | None:
    """Return why u = K x does not stabilise ẋ = A x + B u, with a remedy; None if it does."""
    loops = (_closed_loop(A, B, K), _closed_loop(A, B, -K))
    growth_per_s, opposite_per_s = (
        spectral_abscissa(loop) if np.isfinite(loop).all() else np.inf for loop in loops
    )
    if growth_per_s < 0:
        return None
    remedy = (
        "u = -K x does: give -K (python-control and Matlab return the K of u = -K x)"
        if opposite_per_s < 0
        else "give a gain for which all eigenvalues of A + BK have negative real parts"
    )
    return (
        "u = K x does not stabilise the model: A + BK has an eigenvalue with real part "
        f"{growth_per_s:.3g} /s; {remedy}"
    )


def _closed_loop(A: Matrix, B: Matrix, K: Matrix) -> Matrix:
    with np.errstate(over="ignore", invalid="ignore"):
        return np.asarray(A + B @ K)


class MeasurementSection(ScenarioSection):
    """The measurement of the plant: y = C x + v."""

    C: MatrixRows | None = None
    """C by rows, p x n; by default the identity: every state is measured."""
    noise_std: Deviations | None = None
    """Standard deviation of the normally distributed part of v, p entries; by default 0."""
    noise_bound: Bounds | None = None
    """Bound of the uniformly distributed part of v, p entries; by default 0."""

    def outputs(self, n: int) -> int:
        """Number of measured outputs p of a plant of n states."""
        return n if self.C is None else len(self.C)

    def selects_all(self, n: int) -> bool:
        """Whether C is the identity."""
        return self.C is None or (np.shape(self.C) == (n, n) and bool((np.array(self.C) == np.eye(n)).all()))

    @property
    def is_noisy(self) -> bool:
        """Whether there is any noise."""
        return any(self.noise_std or ()) or any(self.noise_bound or ())

    def matrix(self, n: int) -> Matrix:
        """C of a plant of n states, (p, n)."""
        return np.eye(n) if self.C is None else np.array(self.C)

    def noise(self, n: int) -> tuple[Vector, Vector]:
        """Standard deviations of the normal part of v, bounds of the uniform part, (p,) each."""
        p, rows = self.outputs(n), (self.noise_std, self.noise_bound)
        std, bound = (np.zeros(p) if row is None else np.array(row) for row in rows)
        return std, bound

    def variance(self, n: int) -> Vector:
        """Variance of v, shape (p,)."""
        std, bound = self.noise(n)
        return std**2 + bound**2 / 3

    def check(self, n: int, reason: str) -> None:
        """Raise ValueError, with the key, unless the shapes fit a model of n states."""
        place, p = "plant.measurement", self.outputs(n)
        require_shape(self.C, f"{place}.C", (p, n), f"{reason}; one row per output")
        for key in ("noise_std", "noise_bound"):
            require_length(getattr(self, key), f"{place}.{key}", p, "one per measured output")


class WatchdogSection(ScenarioSection):
    """The input of the plant when no actuation has arrived for too long."""

    timeout_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """The newest actuation is too old when its model state is older than this, in simulated time;
    by default 50 periods of the controller. If actuations cross the network, zero and model act by
    default as soon as an actuation is missing: after the time for which its inputs last, plus the
    longest delay."""
    policy: Literal["hold", "zero", "model"] = "hold"
    """hold: the plant keeps the last input of the newest actuation; zero: the input is 0; model:
    the input of the controller's model, propagated from the newest actuation, which then carries
    x_c."""


class LoadChange(ScenarioSection):
    """A time from which on the plant's loads are others."""

    at_s: NonNegative
    """Simulated time; the load changes within the step of the plant that follows."""
    load: Row
    """The true loads from then on."""


class PlantSection(ScenarioSection):
    """The true plant, unknown to sensor and controller, and how it is drawn."""

    system: AnyPlant = LinearSettings.model_construct()
    """The kind of plant: a table with ``kind``; by default a linear system."""
    draw: Literal["nominal", "uniform", "vertex", "given"] = "nominal"
    """nominal: the model itself; uniform: each entry within its half-width; vertex: each entry at
    one end of its half-width; given: the matrices A and B below."""
    uncertainty_A: HalfWidthRows | None = None
    """Half-widths of the uncertainty box around Â, n x n."""
    uncertainty_B: HalfWidthRows | None = None
    """Half-widths of the uncertainty box around B̂, n x m."""
    A: MatrixRows | None = None
    """The true A, n x n, for draw = "given"."""
    B: MatrixRows | None = None
    """The true B, n x m, for draw = "given"."""
    file: str | None = None
    """An .npz or .mat file with the true A and B, as for model.file."""
    names: dict[Literal["A", "B"], str] | None = None
    """Names of the arrays in the file, if they differ from A and B."""
    initial_state: Row
    """x(0), n entries."""
    initial_state_halfwidth: HalfWidths | None = None
    """x(0) is drawn uniformly within these distances of initial_state; n entries."""
    load: Row | None = None
    """The true loads of model.load, which sensor and controller do not know; by default 0."""
    load_halfwidth: HalfWidths | None = None
    """The loads are drawn uniformly within these distances of load."""
    load_changes: tuple[LoadChange, ...] = ()
    """Other true loads during the run, in the order of time."""
    rate_hz: RateHz = 500.0
    """Steps per second of simulated time."""
    measure_every: Annotated[int, Field(ge=1, le=1_000_000)] = 1
    """Number of plant steps per measurement."""
    measurement: MeasurementSection = MeasurementSection.model_construct()
    disturbances: tuple[AnyDisturbance, ...] = ()
    """Disturbances of the plant; they add up."""
    watchdog: WatchdogSection = WatchdogSection.model_construct()

    @model_validator(mode="after")
    def _check(self) -> Self:
        require_no_file(self.file, self.names)
        for key in ("A", "B"):
            matrix = getattr(self, key)
            if self.draw == "given" and matrix is None:
                raise ValueError(f'{key}: draw = "given" needs both matrices A and B')
            if self.draw != "given" and matrix is not None:
                raise ValueError(f'{key}: matrices are for draw = "given", not "{self.draw}"')
        if self.draw != "nominal" and not isinstance(self.system, LinearSettings):
            raise ValueError(
                f'draw: "{self.draw}" gives a linear plant other entries of A and B; '
                f'without draw, a plant of kind "{self.system.kind}" is used as it is'
            )
        box = (self.uncertainty_A or ()) + (self.uncertainty_B or ())
        if self.draw in ("uniform", "vertex") and not box:
            raise ValueError(f'uncertainty_A: draw = "{self.draw}" needs uncertainty_A or uncertainty_B')
        return self

    def noise_variances(self, n: int, m: int) -> NoiseVariances:
        """Variances of the random disturbances and of the measurement noise."""

        def variance_at(place: Place, size: int) -> Vector:
            variances = [disturbance.variance for disturbance in self.disturbances if disturbance.at == place]
            return np.asarray(np.sum([np.zeros(size), *variances], axis=0))

        return NoiseVariances(variance_at("state", n), variance_at("input", m), self.measurement.variance(n))


class DirectionSection(ScenarioRoot):
    """A direction of the network: what happens to its packets, and the guarantee."""

    loss: Loss = NoLoss.model_construct()
    """Loss of packets, before the guarantee is applied."""
    mansd: Mansd | None = None
    """Largest number of consecutive lost packets; unlimited if not given."""
    constraints: Constraints = ()
    """Further constraints on the losses, e.g. at most 3 in any 10; with mansd they are the
    guarantee."""
    impairments: tuple[AnyImpairment, ...] = ()
    """Further impairments, applied in this order, after the loss."""
    limit: Annotated[int, Field(ge=1, le=1_000_000)] = USUAL_LIMIT
    """Largest number of delayed packets at a time; further packets are dropped."""

    @model_validator(mode="after")
    def _check_direction(self) -> Self:
        require_consistent(self.mansd, self.constraints)
        require_scores(self.impairments, self.loss)
        require_order(self.impairments)
        return self

    @property
    @cached_method
    def link(self) -> LinkSettings:
        """The link of this direction."""
        return LinkSettings.model_construct(  # of checked parts
            impairments=(LossOf.model_construct(loss=self.loss), *self.impairments),
            mansd=self.mansd,
            constraints=self.constraints,
            limit=self.limit,
        )


class AcknowledgementSection(DirectionSection):
    """The direction from controller to sensor, for the acknowledgement baseline."""

    timeout_s: Annotated[FiniteFloat, Field(gt=0, le=1e6)] | None = None
    """After a transmission, the sensor waits for the acknowledgement for this time before it may
    transmit again. By default five measurement periods, plus the longest delay in both
    directions."""


class ActuationSection(DirectionSection):
    """The direction from controller to plant, if actuations cross the network too."""


class NetworkSection(DirectionSection):
    """The lossy network between sensor and controller."""

    mansd: Mansd
    """At most this number of packets is lost in a row (MANSD); for the paper's M = 5 it is 4."""
    loss: Loss
    """Loss of updates, before the guarantee is applied."""
    enforce_mansd: bool = True
    """false: the network ignores mansd and the constraints of the updates, to show the effect of a
    violated assumption; those of acknowledgements and actuations are enforced always."""
    initial_sync: Literal["first_packet", "known_state"] = "first_packet"
    """The means by which t_0 is delivered, as the paper assumes. first_packet: the network passes the
    first update of a loop. known_state: sensor and controller start from x(0)."""
    protocol: Literal["none", "ack"] = "none"
    """none: updates are not acknowledged, the paper's loop. ack: the baseline for comparison; the
    controller acknowledges each update, and x_s is reset only by an acknowledgement."""
    encrypted: bool = False
    """Live, the processes encrypt the vectors of their datagrams (ChaCha20-Poly1305)."""
    acknowledgements: AcknowledgementSection | None = None
    """The direction from controller to sensor, for protocol = "ack"; by default without loss.
    It has no effect if protocol = "none"."""
    actuation: ActuationSection | None = None
    """The direction from controller to plant; by default the controller sends its actuations to
    the plant directly, without loss or delay."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.acknowledgements is not None and "protocol" not in self.model_fields_set:
            raise ValueError(
                'acknowledgements: there are none unless protocol = "ack"; '
                'say protocol = "none" to go without'
            )
        if self.actuation is not None and self.protocol == "ack":
            raise ValueError('actuation: not with protocol = "ack"')
        for name in ("acknowledgements", "actuation"):
            direction: DirectionSection | None = getattr(self, name)
            if direction is not None and direction.link.reads_errors:
                reason = "only updates report the error that maximum_error needs; take another discipline"
                raise ValueError(f"{name}.impairments: {reason}")
        return self

    @property
    def flows(self) -> tuple[Flow, ...]:
        """The flows that cross the network; the index of a flow is the number of its direction."""
        if self.protocol == "ack":
            return Flow.UPDATE, Flow.ACKNOWLEDGEMENT
        return (Flow.UPDATE,) if self.actuation is None else (Flow.UPDATE, Flow.ACTUATION)

    def link_of(self, flow: Flow) -> LinkSettings:
        """The link of a flow that crosses the network."""
        if flow is Flow.UPDATE:
            return self.link
        return (self.actuation or self.reverse).link

    @property
    def longest_burst(self) -> int:
        """Maximum number of consecutive losses that mansd and the constraints allow together."""
        longest = self.guarantee.longest_burst
        assert longest is not None  # at most mansd
        return longest

    @property
    def directions(self) -> Mapping[str, DirectionSection]:
        """The tables of the directions that are given, by their keys in the scenario."""
        sections = {"": self, ".acknowledgements": self.acknowledgements, ".actuation": self.actuation}
        return {f"network{key}": section for key, section in sections.items() if section is not None}

    @property
    def reverse(self) -> AcknowledgementSection:
        """The direction of the acknowledgements, as given or by default."""
        return self.acknowledgements or AcknowledgementSection()

    @property
    @cached_method
    def link(self) -> LinkSettings:
        """The link of the updates, which alone delivers a first packet, and may ignore the guarantee."""
        update: dict[str, object] = {"first_delivered": self.initial_sync == "first_packet"}
        if not self.enforce_mansd:
            update |= {"mansd": None, "constraints": ()}
        return super().link.model_copy(update=update)

    @property
    @cached_method
    def guarantee(self) -> LossGuarantee:
        """The guarantee of mansd and the constraints, also if the network does not enforce it."""
        return join_guarantee(self.mansd, self.constraints)
