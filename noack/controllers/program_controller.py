"""A controller that is a program of its own, such as native/examples/controller_node.c.

In a live run the program is started in the place of the core's controller, with its sockets
(:mod:`noack.runtime.drivers.node_driver`). It makes the same steps, so simulation and replay do without it.
"""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from noack.controllers.controller_settings import ControllerSettings, ControlModel
from noack.controllers.linear_feedback import LinearFeedback
from noack.settings.user_files import FileSettings

Word = Annotated[str, Field(min_length=1, pattern=r"^[^\x00]+$")]


class ProgramControllerSettings(FileSettings, ControllerSettings):
    """u = K(x_c − x_r) + u_r, in a live run by a program of its own; see docs/node.md."""

    is_linear: ClassVar = True
    is_program: ClassVar = True

    kind: Literal["program"]
    file: str
    """The program; a relative name is relative to the scenario file."""
    runner: tuple[Word, ...] = ()
    """What runs the program, if the system does not, e.g. ["qemu-aarch64"]."""

    def law(self, model: ControlModel) -> LinearFeedback:
        return LinearFeedback(model.K)
