"""Settings of a Functional Mock-up Unit; :mod:`noack.plants.systems.fmu_system` runs it."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, FiniteFloat

from noack.plants.plant_settings import Names, PlantSettings, PlantStart
from noack.plants.systems.plant_system import PlantSystem
from noack.settings.section import Row, require_length
from noack.settings.user_files import FileSettings


class FmuSettings(FileSettings, PlantSettings):
    """A Functional Mock-up Unit for co-simulation, FMI 2 or 3: a model from another tool.

    It is native code that runs in the plant's process; see docs/plants.md.
    """

    needs: ClassVar = ("fmpy", "fmi")

    kind: Literal["fmu"]
    file: str
    """The FMU; a relative name is relative to the scenario file."""
    state_variables: Annotated[Names, Field(min_length=1)]
    """The FMU's variables that make up x: real outputs or locals."""
    input_variables: Annotated[Names, Field(min_length=1)]
    """The FMU's real inputs that make up u."""
    initial_variables: Names | None = None
    """The FMU's variables that are set to x(0), in x's order; by default the state variables. With
    an empty list, the FMU starts from its own initial state, which must equal
    plant.initial_state."""
    operating_state: Row | None = None
    """Values of the state variables at x = 0; by default 0."""
    operating_input: Row | None = None
    """Values of the inputs at u = 0; by default 0."""
    parameters: dict[str, bool | int | FiniteFloat | str] = Field({})
    """Start values of further variables of the FMU."""
    on_record: Names = ()
    """Further variables of the FMU that are recorded, as z."""

    @property
    def internal_names(self) -> tuple[str, ...]:
        return self.on_record

    def check(self, n: int, m: int) -> None:
        """Require one variable for each of n states and m inputs.

        Raises:
            ValueError: the numbers differ.
        """
        why = f"the model has {n} states and {m} inputs"
        require_length(self.state_variables, "plant.system.state_variables", n, why)
        require_length(self.input_variables, "plant.system.input_variables", m, why)
        require_length(self.initial_variables or None, "plant.system.initial_variables", n, why)
        require_length(self.operating_state, "plant.system.operating_state", n, why)
        require_length(self.operating_input, "plant.system.operating_input", m, why)

    def system(self, start: PlantStart) -> PlantSystem:
        from noack.plants.systems.fmu_system import FmuSystem

        return FmuSystem(self, start.x0)
