"""Writes behind arrays, each in a child process, with a core under ASan, which ends the child.

So test_sanitized.py knows that ASan sees the end of each kind of memory that the core uses.
"""

import os
from collections.abc import Callable
from typing import Any

from noack.core.core_library import CoreMemory, core, ffi
from noack.machines.loop_machines import LoopMachines
from tests.noack.machines.any_machines import Sizes, controller, plant, sensor

OF = Sizes(3, 2, 2, acknowledged=True)
ENDS: dict[str, Callable[[LoopMachines, CoreMemory], Any]] = {
    "reals": lambda own, memory: memory.reals([1.0, 2.0, 3.0]) + 3,
    "zeros": lambda own, memory: memory.zeros(200) + 200,
    "integers": lambda own, memory: memory.integers([1, 2, 3]) + 3,
    "matrices": lambda own, memory: (
        own.machines[0].model.transitions.matrices + 9 * own.machines[0].model.transitions.places
    ),
    "sent": lambda own, memory: own.machines[0].sent + own.machines[0].sent_places,
    "due": lambda own, memory: own.core.due_ns + 1,
    "heap": lambda own, memory: own.core.heap + 1,
    "rows": lambda own, memory: own.core.tables[1].rows + 4 * own.core.tables[1].row_bytes,
    "notes": lambda own, memory: own.core.notes + own.core.note_places,
    "plants": lambda own, memory: LoopMachines([plant(1, OF)]).core.plants + 1,
    "sensors": lambda own, memory: own.core.sensors + 1,
    "controllers": lambda own, memory: LoopMachines([controller(1, OF)]).core.controllers + 1,
    "process": lambda own, memory: own.core + 1,
}
"""The place behind the last one of an array, by the kind of memory."""


def main() -> None:
    """Print the kinds whose end was not seen."""
    memory, own = CoreMemory(), LoopMachines([sensor(1, OF, 0)], rows=4)
    one = memory.reals([1.0])
    for kind, end in ENDS.items():
        child = os.fork()
        if child == 0:
            core.noack_product(1, 1, one, one, ffi.cast("double *", end(own, memory)))
            os._exit(0)
        _, status = os.waitpid(child, 0)
        if not os.WIFSIGNALED(status):
            print(kind)


if __name__ == "__main__":
    main()
