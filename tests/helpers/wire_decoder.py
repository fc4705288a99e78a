"""The core's receiver of datagrams, one call at a time."""

import numpy as np

from noack.core.core_library import core, ffi
from noack.core.linear_systems import Vector
from noack.protocol import wire_format

NO_VECTOR: Vector = np.zeros(0)  # the vector of an acknowledgement


class Decoder:
    """Turns the datagrams of one flow of a loop into messages; others are counted and rejected.

    Only a datagram that is newer than every one accepted before is accepted.
    """

    def __init__(
        self,
        flow: wire_format.Flow,
        dimension: int,
        run_id: int,
        key: bytes,
        *,
        not_after_ns: int = 2**62 - 1,
        loop: int = 0,
        encrypted: bool = False,
    ) -> None:
        self._wire = wire_format.Wire(run_id, key, encrypted=encrypted)
        self._flow, self._loop = flow, loop
        self._reception = ffi.new(
            "noack_reception *",
            {
                "flow": flow, "entries": dimension, "newest": -1,
                "not_after_ns": not_after_ns,
            },
        )  # fmt: skip
        self._message = ffi.new("noack_message *")

    def decode(self, datagram: bytes, *, from_peer: bool = True) -> wire_format.Message | None:
        """Return the message, or None when the datagram was rejected (see ``rejected``).

        From any source but the peer's address even an authentic datagram is a replay.
        """
        result = self._examine(datagram, from_peer, opened=False)
        if result == core.NOACK_ENCRYPTED:
            result = core.NOACK_BAD_TAG
            assert self._wire.seal is not None
            content = self._wire.seal.decrypt(datagram, wire_format.HEADER_BYTES)
            if content is not None:
                readable = datagram[: wire_format.HEADER_BYTES] + content + datagram[-wire_format.TAG_BYTES :]
                result = self._examine(readable, from_peer, opened=True)
        message = self._message
        core.noack_wire_count(self._reception, result, message)
        if result != core.NOACK_ACCEPTED:
            return None
        vector = np.array(ffi.unpack(message.vector, message.entries), np.float64)
        return wire_format.Message(
            self._flow, message.sequence, message.t_ns, vector, self._loop, message.error_level
        )

    def _examine(self, datagram: bytes, from_peer: bool, *, opened: bool) -> int:
        return int(
            core.noack_wire_examine(
                self._wire.core, self._reception, self._loop, datagram, len(datagram),
                from_peer, opened, self._message,
            )
        )  # fmt: skip

    @property
    def accepted(self) -> int:
        """Number of accepted datagrams."""
        return int(self._reception.accepted)

    @property
    def rejected(self) -> dict[wire_format.Rejection, int]:
        """Number of rejected datagrams by reason."""
        return wire_format.rejected_of(self._reception)

    def report(self) -> dict[str, object]:
        """Counters, for the run's summary."""
        return wire_format.reception_report(self._reception)
