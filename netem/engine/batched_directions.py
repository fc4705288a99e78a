"""The directions of links in the pump's memory, with the core's state of each."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from netem.engine.pump.pump_layout import Memory
from netem.link_state import LinkState
from noack.core.core_library import address_of
from noack.impairments.link_records import RecordedDecision
from noack.impairments.link_settings import LinkSettings

_ROWS = 16


class BatchedDirection(LinkState):
    """One direction of a link.

    Args:
        settings, seed, name, decisions, restarted: see :class:`netem.link_state.LinkState`.
        number: number of the direction in the pump's memory; even: forward, odd: reverse.
        memory: the pump's memory.
    """

    def __init__(
        self,
        settings: LinkSettings,
        seed: int,
        name: Sequence[str],
        number: int,
        memory: Memory,
        decisions: Sequence[Sequence[RecordedDecision]] = (),
        restarted: bool = False,
    ) -> None:
        super().__init__(
            settings, seed, *name, decisions=decisions, rows=_ROWS, restarted=restarted
        )
        self._row = memory.directions[number : number + 1]
        self._write_row()

    def change(self, settings: LinkSettings, latest_ns: NDArray[np.int64]) -> None:
        """Apply other settings; see :meth:`netem.link_state.LinkState.change`."""
        super().change(settings, latest_ns)
        self._write_row()

    def _write_row(self) -> None:
        self._row["link"], self._row["mansd"] = address_of(self.core), self.core.mansd
        flips_bits = any(one.flips_bits for one in self.settings.impairments)
        self._row["keeps"] = self.tracks or flips_bits
