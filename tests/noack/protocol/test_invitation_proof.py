"""The proof of invitation, as documented in docs/wire.md."""

import hashlib
import socket

import pytest

from noack.runtime.connections.coordinator_link import PROOF_BYTES, InvitationProof

KEY = bytes(range(32))
COORDINATOR = ("192.0.2.1", 7400)
PROOF = InvitationProof(KEY)


@pytest.mark.parametrize(
    ("own", "coordinator"),
    [
        (("192.0.2.7", 40_000), COORDINATOR),
        (("2001:db8::7", 40_000), ("2001:db8::1", 7400)),
    ],
)
def test_it_has_the_documented_layout(own: tuple[str, int], coordinator: tuple[str, int]) -> None:
    derived = hashlib.blake2b(b"noack connections", key=KEY, digest_size=32).digest()
    content = b"NJ\1\0"
    for host, port in (own, coordinator):
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        content += socket.inet_pton(family, host).ljust(16, b"\0") + port.to_bytes(2, "big")
    tag = hashlib.blake2b(content, key=derived, digest_size=16).digest()
    assert PROOF.make(own, coordinator) == b"NJ\1\0" + tag
    assert PROOF.check(b"NJ\1\0" + tag, own, coordinator)


def test_it_is_refused_at_the_first_wrong_byte_and_for_any_other_connection() -> None:
    own = ("192.0.2.7", 40_000)
    proof = PROOF.make(own, COORDINATOR)
    assert len(proof) == PROOF_BYTES
    for length in range(PROOF_BYTES):
        assert PROOF.check(proof[:length], own, COORDINATOR) is None
    for at in range(PROOF_BYTES):
        changed = bytearray(proof)
        changed[at] ^= 1
        assert PROOF.check(bytes(changed), own, COORDINATOR) is False
    for other in (("192.0.2.8", 40_000), ("192.0.2.7", 40_001)):
        assert PROOF.check(proof, other, COORDINATOR) is False
    assert PROOF.check(proof, COORDINATOR, own) is False
    assert InvitationProof(bytes(32)).check(proof, own, COORDINATOR) is False
