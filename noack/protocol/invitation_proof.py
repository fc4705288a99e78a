"""The first bytes of a connection with the coordinator: a proof that its maker has an invitation.

The coordinator checks it before anything that costs more, so that a flood of connections without
it costs little. Layout, version 1::

    offset  size  field
         0     4  the bytes "NJ", version 1, reserved 0
         4    16  tag: keyed BLAKE2b over the four bytes and the connection's addresses

The addresses are those of the connecting end and of the coordinator, each as 16 bytes (of IPv4:
4 bytes and 12 zeros) and its port in two bytes, big endian. So the proof of one connection is of no
use for another one. The coordinator answers with one byte (:class:`Answer`); then TLS begins.
"""

import hashlib
import hmac
import ipaddress
from enum import Enum

from noack.protocol.datagram_seal import KEY_BYTES, TAG_BYTES, Tagger

_HEAD = b"NJ\x01\x00"
PROOF_BYTES = len(_HEAD) + TAG_BYTES
_PURPOSE = b"noack connections"
_ADDRESS_BYTES = 16


class Answer(bytes, Enum):
    """The coordinator's answer to a proof."""

    ADMITTED = b"+"
    REFUSED = b"-"
    """The bytes are no proof for this connection under the key of this run."""
    NO_ROOM = b"*"
    """Too many connections wait; this one had not sent its proof."""


class InvitationProof:
    """Makes and checks proofs under the key of a run, which has 32 bytes."""

    def __init__(self, key: bytes) -> None:
        # A key of its own: the tags of datagrams are made with the run's key itself.
        self._tag = Tagger(hashlib.blake2b(_PURPOSE, key=key, digest_size=KEY_BYTES).digest())

    def make(self, own: tuple[str, int], coordinator: tuple[str, int]) -> bytes:
        """Return the proof for a connection; addresses are numeric."""
        return _HEAD + self._tag(_HEAD + _packed(own) + _packed(coordinator))

    def check(self, found: bytes, other: tuple[str, int], own: tuple[str, int]) -> bool | None:
        """Whether bytes are the proof of the other end; None: a part of one may be there."""
        if not _HEAD.startswith(found[: len(_HEAD)]):
            return False
        if len(found) < PROOF_BYTES:
            return None
        return hmac.compare_digest(found, self.make(other, own))


def _packed(address: tuple[str, int]) -> bytes:
    """Return an address as bytes of a fixed length; a scope is left out."""
    host = ipaddress.ip_address(address[0].partition("%")[0])
    return host.packed.ljust(_ADDRESS_BYTES, b"\0") + address[1].to_bytes(2, "big")
