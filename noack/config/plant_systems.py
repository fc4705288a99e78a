"""Settings of the systems that a plant can be; :mod:`plant_server.systems` has their dynamics.

The loop sees a system through x and u, deviations from an operating point; the system's own state z
may have other coordinates, and more of them.
"""

from importlib.util import find_spec
from typing import Annotated, ClassVar, Literal, Self

from pydantic import Discriminator, Field, FiniteFloat, Tag, model_validator

from noack.core.errors import CallerError
from noack.protocol.wire_format import MAX_DIMENSION
from noack.settings.matrices import Row, require_length
from noack.settings.section import NonNegative, Positive, ScenarioSection
from noack.settings.user_class import ClassSettings
from noack.settings.user_files import FileSettings

Names = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(max_length=MAX_DIMENSION)]

Share = Annotated[FiniteFloat, Field(gt=0, lt=1)]


class PlantSettings(ScenarioSection):
    """What every system's settings have."""

    states: ClassVar[tuple[str, ...]] = ()
    """What x consists of, with units; empty if that is the model's to say."""
    inputs: ClassVar[tuple[str, ...]] = ()
    """What u consists of, with units."""
    needs: ClassVar[tuple[str, str] | None] = None
    """The module without which there is no such system, and the extra of noack that brings it."""

    @property
    def settling_s(self) -> float:
        """How long what x does not tell of z takes to follow x and u."""
        return 0.0

    @property
    def internal_names(self) -> tuple[str, ...]:
        """Names of the entries of z; of a system without any nothing but x is on record."""
        return ()

    def check(self, n: int, m: int) -> None:
        """Require that a model of n states and m inputs can be a model of this system.

        Raises:
            ValueError: it cannot.
        """
        for what, names, count in (("states", self.states, n), ("inputs", self.inputs, m)):
            if names and len(names) != count:
                raise ValueError(
                    f"plant.system: it has {len(names)} {what} ({', '.join(names)}); "
                    f"the model has {count}"
                )

    def require_installed(self) -> None:
        """Check that what the system needs is installed.

        Raises:
            CallerError: it is not.
        """
        if self.needs is not None and find_spec(self.needs[0]) is None:
            raise CallerError(
                f'plant.system.kind: "{getattr(self, "kind", "")}" needs what is not installed; '
                f"pip install 'noack[{self.needs[1]}]'"
            )


class LinearSettings(PlantSettings):
    """ẋ = A x + B u, as the plant's other keys draw it."""

    kind: Literal["linear"] = "linear"
    """What the plant is."""


class CartPoleSettings(PlantSettings):
    """A pole upright on a cart that a force moves, on a straight rail.

    Unless given, the parameters are those of the Control Tutorials for MATLAB and Simulink
    (University of Michigan, "Inverted Pendulum"); its angle has the opposite sign.
    """

    states: ClassVar = ("position, m", "velocity, m/s", "angle from upright, rad", "rate, rad/s")
    inputs: ClassVar = ("force, N",)

    kind: Literal["cart_pole"]
    """What the plant is."""
    cart_kg: Positive = 0.5
    """Mass of the cart."""
    pole_kg: Positive = 0.2
    """Mass of the pole."""
    length_m: Positive = 0.3
    """From the pivot to the pole's centre of mass."""
    inertia_kg_m2: NonNegative = 0.006
    """Of the pole, about its centre of mass."""
    friction_n_s_per_m: NonNegative = 0.1
    """Viscous friction of the cart."""
    gravity_m_per_s2: Positive = 9.8
    """Gravity."""


_CORE = ("x_position", "y_position", "steering_angle", "speed", "yaw")
_SINGLE_TRACK = (*_CORE, "yaw_rate", "slip_angle")
_MULTI_BODY = (
    *_CORE, "yaw_rate",
    "roll", "roll_rate", "pitch", "pitch_rate", "lateral_velocity", "height", "climb_rate",
    "front_roll", "front_roll_rate", "front_lateral_velocity", "front_height", "front_climb_rate",
    "rear_roll", "rear_roll_rate", "rear_lateral_velocity", "rear_height", "rear_climb_rate",
    "left_front_wheel_rate", "right_front_wheel_rate",
    "left_rear_wheel_rate", "right_rear_wheel_rate",
    "front_axle_shift", "rear_axle_shift",
)  # fmt: skip


class VehicleSettings(PlantSettings):
    """A road vehicle of CommonRoad's vehicle models, beside the lane that the x-axis is.

    Althoff and Würsching, "CommonRoad: Vehicle Models", 2020. x is as in the lane models: of the
    library's coordinates V and Y_g have the opposite sign. u is the steering angle asked for.
    """

    states: ClassVar = (
        "lateral velocity V, m/s", "yaw rate r, rad/s", "yaw psi, rad", "lateral position Y_g, m",
    )  # fmt: skip
    inputs: ClassVar = ("steering angle, rad",)
    needs: ClassVar = ("vehiclemodels", "vehicle")

    kind: Literal["vehicle"]
    """What the plant is."""
    model: Literal["kinematic", "single_track", "drift", "multi_body"] = "single_track"
    """Which of the library's: ks (kst of the truck), st, std or mb, of ever more states."""
    parameters: Literal["ford_escort", "bmw_320i", "vw_vanagon", "truck"] = "bmw_320i"
    """Which of the library's parameter sets, 1 to 4; the truck is kinematic only."""
    speed_m_per_s: Positive = 15.0
    """The speed that the vehicle has at first, and keeps."""
    speed_gain_per_s: Annotated[FiniteFloat, Field(ge=0, le=100)] = 1.0
    """It accelerates by so much times what it lacks of its speed."""
    steering_s: Annotated[FiniteFloat, Field(ge=0.001, le=10)] = 0.05
    """Time constant of the servo that steers; the vehicle limits its angle and its rate."""
    friction: Annotated[FiniteFloat, Field(gt=0, le=2)] = 1.0
    """The road's friction, as a multiple of the tyres' own; of models that have any."""

    @property
    def settling_s(self) -> float:
        """Eight time constants of the steering."""
        return 8 * self.steering_s

    @property
    def library_model(self) -> str:
        """The library's name of the model."""
        kinematic = "kst" if self.parameters == "truck" else "ks"
        names = {"kinematic": kinematic, "single_track": "st", "drift": "std", "multi_body": "mb"}
        return names[self.model]

    @property
    def internal_names(self) -> tuple[str, ...]:
        """The states of the library's model, SI units."""
        kinematic = (*_CORE, "hitch_angle") if self.parameters == "truck" else _CORE
        return {
            "kinematic": kinematic,
            "single_track": _SINGLE_TRACK,
            "drift": (*_SINGLE_TRACK, "front_wheel_rate", "rear_wheel_rate"),
            "multi_body": _MULTI_BODY,
        }[self.model]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.parameters == "truck" and self.model != "kinematic":
            raise ValueError(
                f'parameters: the library knows no masses of its "truck", which "{self.model}" '
                'needs; take model = "kinematic" or another vehicle'
            )
        if self.friction != 1 and self.model in ("kinematic", "single_track"):
            raise ValueError(f'friction: "{self.model}" has none; "drift" and "multi_body" have')
        return self


class FourTankSettings(PlantSettings):
    """Two tanks that two pumps fill, each through another tank above it as well.

    Johansson, "The Quadruple-Tank Process", IEEE Trans. Control Systems Technology 8(3), 2000;
    unless given, the parameters are its minimum-phase P₋. x and u are deviations from the levels
    at which the operating voltages hold the water.
    """

    states: ClassVar = ("level 1, cm", "level 2, cm", "level 3, cm", "level 4, cm")
    inputs: ClassVar = ("pump 1, V", "pump 2, V")

    kind: Literal["four_tank"]
    """What the plant is."""
    areas_cm2: tuple[Positive, Positive, Positive, Positive] = (28.0, 32.0, 28.0, 32.0)
    """Cross-sections of the tanks; 1 and 2 are below 3 and 4."""
    holes_cm2: tuple[Positive, Positive, Positive, Positive] = (0.071, 0.057, 0.071, 0.057)
    """Cross-sections of their outlets."""
    pumps_cm3_per_v_s: tuple[Positive, Positive] = (3.33, 3.35)
    """Flow of each pump per volt."""
    valves: tuple[Share, Share] = (0.70, 0.60)
    """Shares of the pumps' flows that go to the tanks below; pump 1 to tanks 1 and 4, 2 to 2 and 3.
    Of a sum above 1 the process is minimum-phase."""
    voltages_v: tuple[Positive, Positive] = (3.0, 3.0)
    """Voltages of the pumps at the operating point."""
    gravity_cm_per_s2: Positive = 981.0
    """Gravity."""

    @property
    def internal_names(self) -> tuple[str, ...]:
        """The levels themselves, cm."""
        return ("level_1", "level_2", "level_3", "level_4")


class QuadrotorSettings(PlantSettings):
    """A rigid body that hovers: its thrust along its own axis, torques about them, drag in the air.

    Unless given, the parameters are of Luukkonen, "Modelling and Control of Quadcopter", Aalto
    University, 2011. u is the thrust beyond the weight and the torques.
    """

    states: ClassVar = (
        "x, m", "y, m", "z, m", "roll, rad", "pitch, rad", "yaw, rad",
        "v_x, m/s", "v_y, m/s", "v_z, m/s",
        "roll rate p, rad/s", "pitch rate q, rad/s", "yaw rate r, rad/s",
    )  # fmt: skip
    inputs: ClassVar = ("thrust beyond the weight, N", "torque of roll, N m",
                        "torque of pitch, N m", "torque of yaw, N m")  # fmt: skip

    kind: Literal["quadrotor"]
    """What the plant is."""
    mass_kg: Positive = 0.468
    """Mass."""
    inertia_kg_m2: tuple[Positive, Positive, Positive] = (4.856e-3, 4.856e-3, 8.801e-3)
    """Principal moments of inertia."""
    drag_kg_per_s: tuple[NonNegative, NonNegative, NonNegative] = (0.25, 0.25, 0.25)
    """Drag per velocity, along the axes of the world."""
    gravity_m_per_s2: Positive = 9.81
    """Gravity."""


class FmuSettings(FileSettings, PlantSettings):
    """A Functional Mock-up Unit for co-simulation, FMI 2 or 3: any tool's model, exported.

    It is native code that is run in the plant's process; see docs/plants.md.
    """

    needs: ClassVar = ("fmpy", "fmi")

    kind: Literal["fmu"]
    """What the plant is."""
    file: str
    """The FMU; relative names begin at the scenario file."""
    state_variables: Annotated[Names, Field(min_length=1)]
    """Its variables that make up x: outputs or locals, real."""
    input_variables: Annotated[Names, Field(min_length=1)]
    """Its inputs that make up u, real."""
    initial_variables: Names | None = None
    """Its variables that are set to x(0), in x's order; by default the state variables. An empty
    list: the FMU begins where it wants, which must be plant.initial_state."""
    operating_state: Row | None = None
    """What the state variables are where x = 0; by default 0."""
    operating_input: Row | None = None
    """What the inputs are where u = 0; by default 0."""
    parameters: dict[str, bool | int | FiniteFloat | str] = Field({})
    """Start values of further variables of it."""
    on_record: Names = ()
    """Further variables of it that are on record, as z."""

    @property
    def internal_names(self) -> tuple[str, ...]:
        """Names of the variables that are on record beside x."""
        return self.on_record

    def check(self, n: int, m: int) -> None:
        """Require a variable for each of n states and m inputs.

        Raises:
            ValueError: there are more, or fewer.
        """
        why = f"the model has {n} states and {m} inputs"
        require_length(self.state_variables, "plant.system.state_variables", n, why)
        require_length(self.input_variables, "plant.system.input_variables", m, why)
        require_length(self.initial_variables or None, "plant.system.initial_variables", n, why)
        require_length(self.operating_state, "plant.system.operating_state", n, why)
        require_length(self.operating_input, "plant.system.operating_input", m, why)


class PythonSettings(ClassSettings, PlantSettings):
    """A class of the user's own, from an installed package or from a file.

    Its code is run in the plant's process; see docs/plants.md for what the class must offer.
    """

    group: ClassVar = "noack.plants"

    kind: Literal["python"]
    """What the plant is."""
    on_record: Names = ()
    """Names of the entries of its own state z, which is then on record."""

    @property
    def internal_names(self) -> tuple[str, ...]:
        """Names of the entries of z."""
        return self.on_record


def _kind(given: object) -> str:
    # A table without `kind` is a linear plant's.
    if isinstance(given, dict):
        return str(given.get("kind", "linear"))
    return str(getattr(given, "kind", "linear"))


AnySystem = Annotated[
    Annotated[LinearSettings, Tag("linear")]
    | Annotated[CartPoleSettings, Tag("cart_pole")]
    | Annotated[FourTankSettings, Tag("four_tank")]
    | Annotated[QuadrotorSettings, Tag("quadrotor")]
    | Annotated[VehicleSettings, Tag("vehicle")]
    | Annotated[FmuSettings, Tag("fmu")]
    | Annotated[PythonSettings, Tag("python")],
    Discriminator(_kind),
]
