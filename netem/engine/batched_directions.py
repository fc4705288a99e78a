"""The directions of links in the pump's memory: programs, and states that grow with the flows."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from netem.engine.compiled_pump import functions
from netem.engine.compiled_rules import compiled_program, compiled_state, set_flow
from netem.engine.pump.pump_layout import STATES, TABLES
from netem.rule_program import empty_state, program_of, recent_width
from noack.impairments.link_records import LinkMemory, LinkProgram, RecordedDecision
from noack.impairments.link_settings import LinkSettings

_ROWS = 16


class Grown(NamedTuple):
    """The arrays whose length is the number of flows."""

    flows: NDArray[Any]
    memory: NDArray[Any]
    recent_ns: NDArray[Any]


class BatchedDirection:
    """One direction of a link.

    Args:
        settings: the settings.
        seed: seed of the random streams.
        name: names of the link and the direction.
        decisions: recorded decisions per flow.
        row: its row of :data:`netem.engine.pump.pump_layout.DIRECTION`, (1,).
        link_state: its row of :class:`noack.impairments.link_records.LinkState`, (1,).
        counters: its row of :class:`noack.impairments.link_records.Counters`, (1,).
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        name: tuple[str, str],
        decisions: Sequence[Sequence[RecordedDecision]],
        row: NDArray[Any],
        link_state: NDArray[Any],
        counters: NDArray[Any],
    ) -> None:
        self.settings = settings
        self._seed, self._name = seed, name
        self._row = row
        self._link_state, self._counters = link_state, counters
        plain = program_of(settings, seed, *name, decisions=decisions)
        self.program = compiled_program(plain)
        self.state = self._state(plain, _ROWS)
        self._show()

    @property
    def rows(self) -> int:
        """Maximum number of flows without growing."""
        return len(self.state.flows)

    def start_flow(self, row: int, number: int) -> None:
        """Initialise a free row for a new flow; grow if necessary."""
        while row >= self.rows:
            self._grow()
        set_flow(self.state, row, number, self.settings.first_delivered)

    def change(self, settings: LinkSettings, latest_ns: NDArray[np.int64]) -> None:
        """Apply other settings.

        Args:
            settings: the new settings.
            latest_ns: (rows,) last departure time of the packets in flight of each flow; −1: none.
        """
        old = self.program
        plain = program_of(settings, self._seed, *self._name, tracks=old.tracks)
        # Reuse the arrays: there may be millions of recorded decisions, and the relay waits.
        program = compiled_program(plain)._replace(
            decisions=old.decisions, decisions_begin=old.decisions_begin
        )
        state = self._state(plain, self.rows)._replace(flows=self.state.flows)
        recent_ns: NDArray[np.int64] = state.recent_ns  # type: ignore[assignment]
        recent_ns[:] = -1
        functions().carry(old, self.state, program, state, latest_ns)
        self.settings, self.program, self.state = settings, program, state
        self._show()

    def _state(self, plain: LinkProgram, rows: int) -> LinkMemory:
        state = compiled_state(plain, empty_state(plain), rows, recent_width(plain))
        return state._replace(link=self._link_state[0], counters=self._counters[0])

    def _grow(self) -> None:
        old = self.state
        grown = Grown(*(_doubled(getattr(old, field)) for field in Grown._fields))
        self.state = old._replace(**grown._asdict())
        self._show()

    def _show(self) -> None:
        """Store the addresses and lengths of all arrays in the direction's row."""
        row = self._row
        for name in TABLES:
            table: Any = getattr(self.program, name)
            row[name] = table.ctypes.data
            row[f"{name}_rows"] = len(table)
        for name in ("mansd", "limit", "tracks"):
            row[name] = getattr(self.program, name)
        flips_bits = any(one.flips_bits for one in self.settings.impairments)
        row["keeps"] = self.program.tracks or flips_bits
        state: Any = self.state
        for name in STATES:
            row[name] = getattr(state, name).ctypes.data
        row["rows"] = len(state.flows)
        row["width"] = state.recent_ns.shape[1]
        row["departure_rows"] = len(state.departures_ns)


def _doubled(array: NDArray[Any]) -> NDArray[Any]:
    grown = np.zeros((2 * len(array), *array.shape[1:]), array.dtype)
    grown[: len(array)] = array
    return grown
