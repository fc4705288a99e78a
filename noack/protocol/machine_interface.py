"""What machines emit beside messages, and where in a run they begin."""

from typing import NamedTuple

from noack.core.linear_systems import Vector
from noack.protocol.wire_format import Message

GENERATION = 2**40
"""A restarted process numbers its messages from generation · 2⁴⁰ on, above all earlier ones."""


class Start(NamedTuple):
    """Where in a run a machine begins its work."""

    generation: int = 0
    """How often its process was restarted in this run; a restarted process knows no state."""
    from_ns: int = 0  # no timer is due before

    @property
    def first_number(self) -> int:
        """The first of its sequence numbers, and of the numbers of its inputs."""
        return self.generation * GENERATION

    @property
    def is_restart(self) -> bool:
        """Whether the process was restarted during the run."""
        return self.generation > 0


BEGINNING = Start()  # the start of the run


class Record(NamedTuple):
    """A row for the numeric record; ``noack.protocol.record_tables`` documents the tables."""

    table: str
    row: tuple[object, ...]


RESTART = "restart"  # level of the notice of a restarted process
FAILED = "failed"  # level of the notice of a plant or controller that cannot continue


class Notice(NamedTuple):
    """A line for the run's log, such as a violated assumption."""

    t_ns: int
    level: str
    text: str
    loop: int | None = None
    """The number of the loop that it is about, in a run of several loops."""

    def line(self) -> dict[str, object]:
        """Return the fields; without the loop, if there is none."""
        line = self._asdict()
        return line if self.loop is not None else {k: line[k] for k in line if k != "loop"}


Output = Message | Record | Notice


class External:
    """A part of a machine that another program has: connected before the run.

    A replay cannot ask it again: there its answers are the recorded ones.
    """

    recorded: Vector | None = None
    """The next answer, in a replay."""

    def connect(self) -> None:
        """Connect, unless this was done; raise CallerError if that fails."""
