"""The directions of links in the pump's memory: programs, and states that grow with the flows."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from netem.engine.compiled_rules import compiled_program, compiled_state, set_flow
from netem.engine.pump.pump_layout import PER_FLOW, STATES, TABLES, Memory
from netem.engine.pump_memory import doubled
from netem.rule_program import new_losses, program_of
from noack.impairments.link_records import LinkMemory, LinkProgram, RecordedDecision
from noack.impairments.link_settings import LinkSettings

_ROWS = 16


class BatchedDirection:
    """One direction of a link.

    Args:
        settings, seed, name, decisions, restarted: see :class:`netem.link_machine.Link`.
        number: number of the direction in the pump's memory; even: forward, odd: reverse.
        memory: the pump's memory.
        carry_over: :func:`netem.rules.settings_change.carry`, compiled or not.
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        name: Sequence[str],
        number: int,
        memory: Memory,
        carry_over: Callable[..., None],
        decisions: Sequence[Sequence[RecordedDecision]] = (),
        restarted: bool = False,
    ) -> None:
        self.settings, self._restarted = settings, restarted
        self._seed, self._name, self._carry = seed, name, carry_over
        self._row = memory.directions[number : number + 1]
        self._link_state, self._counters = memory.link_states[number], memory.counters[number]
        plain = program_of(settings, seed, *name, decisions=decisions)
        self.program = compiled_program(plain)
        self.state = self._state(plain, _ROWS)
        self._write_row()

    @property
    def rows(self) -> int:
        """Maximum number of flows without growing."""
        return len(self.state.flows)

    def start_flow(self, row: int, number: int) -> None:
        """Initialise a free row for a new flow; grow if necessary."""
        while row >= self.rows:
            grown: dict[str, Any] = {one: doubled(getattr(self.state, one)) for one in PER_FLOW}
            self.state = self.state._replace(**grown)
            self._write_row()
        set_flow(self.state, row, number, self.settings.first_delivered, self._first_losses)

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
        self._carry(old, self.state, program, state, latest_ns)
        self.settings, self.program, self.state = settings, program, state
        self._write_row()

    def _state(self, plain: LinkProgram, rows: int) -> LinkMemory:
        self._first_losses = new_losses(plain, restarted=self._restarted)
        state = compiled_state(plain, rows)
        return state._replace(link=self._link_state, counters=self._counters)

    def _write_row(self) -> None:
        """Write the addresses and lengths of all arrays."""
        row = self._row
        for name in TABLES:
            table: Any = getattr(self.program, name)
            row[name] = table.ctypes.data
            row[f"{name}_rows"] = len(table)
        for name in ("recovery", "mansd", "limit", "tracks"):
            row[name] = getattr(self.program, name)
        flips_bits = any(one.flips_bits for one in self.settings.impairments)
        row["keeps"] = self.program.tracks or flips_bits
        state: Any = self.state
        for name in STATES:
            row[name] = getattr(state, name).ctypes.data
        row["rows"] = len(state.flows)
        row["width"], row["loss_width"] = state.recent_ns.shape[1], state.losses.shape[1]
        row["departure_rows"] = len(state.departures_ns)
