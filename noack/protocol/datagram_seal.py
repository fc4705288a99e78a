"""What protects a datagram of the loop under the run's key: a tag, or encryption with a tag.

Both add 16 bytes behind the vector, and cover the header, which is always readable. Nobody without
the key can change, make or, if it is encrypted, read what they protect.
"""

import hashlib
import hmac
from typing import Protocol

KEY_BYTES = 32
TAG_BYTES = 16
_FLOW, _LOOP, _SEQUENCE = slice(3, 4), slice(6, 8), slice(16, 24)  # in the header
_PURPOSE = b"noack datagrams"


class DatagramSeal(Protocol):
    """Protects datagrams, and checks them."""

    version: int
    """Version of the layout, in the header of each datagram."""

    def close(self, header: bytes, vector: bytes) -> bytes:
        """Return the datagram with this header and vector."""
        ...

    def open(self, datagram: bytes, header_bytes: int) -> bytes | None:
        """Return the vector of a datagram; None if it was not made under the same key."""
        ...


class Tagger:
    """Computes the tag of a datagram's content under one key; keying is done once."""

    def __init__(self, key: bytes) -> None:
        _require_length(key)
        self._keyed = hashlib.blake2b(key=key, digest_size=TAG_BYTES)

    def __call__(self, content: bytes) -> bytes:
        """Return the tag."""
        state = self._keyed.copy()
        state.update(content)
        return state.digest()


class AuthenticatedSeal:
    """Layout version 1: the vector as it is, and a tag by keyed BLAKE2b (RFC 7693)."""

    version = 1

    def __init__(self, key: bytes) -> None:
        self._tag = Tagger(key)

    def close(self, header: bytes, vector: bytes) -> bytes:
        """Return the datagram with this header and vector."""
        content = header + vector
        return content + self._tag(content)

    def open(self, datagram: bytes, header_bytes: int) -> bytes | None:
        """Return the vector of a datagram; None if it was not made under the same key."""
        content = datagram[:-TAG_BYTES]
        if hmac.compare_digest(self._tag(content), datagram[-TAG_BYTES:]):
            return content[header_bytes:]
        return None


class EncryptedSeal:
    """Layout version 2: the vector encrypted by ChaCha20-Poly1305 (RFC 8439), with its tag.

    The nonce is the flow, the loop and the sequence number. No two datagrams of a run have the same
    ones: a restarted process numbers its messages above all of its predecessor's.
    """

    version = 2

    def __init__(self, key: bytes) -> None:
        # Loaded here, since few runs are encrypted.
        from cryptography.exceptions import InvalidTag
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

        _require_length(key)
        # A key of its own: the tags of other datagrams are made with the run's key itself.
        derived = hashlib.blake2b(_PURPOSE, key=key, digest_size=KEY_BYTES).digest()
        self._cipher, self._invalid = ChaCha20Poly1305(derived), InvalidTag

    def close(self, header: bytes, vector: bytes) -> bytes:
        """Return the datagram with this header and vector."""
        return header + self._cipher.encrypt(_nonce_of(header), vector, header)

    def open(self, datagram: bytes, header_bytes: int) -> bytes | None:
        """Return the vector of a datagram; None if it was not made under the same key."""
        header = datagram[:header_bytes]
        try:
            return self._cipher.decrypt(_nonce_of(header), datagram[header_bytes:], header)
        except self._invalid:
            return None


def seal_of(key: bytes, *, encrypted: bool) -> DatagramSeal:
    """Return what protects the datagrams of a run; its key has 32 bytes."""
    return EncryptedSeal(key) if encrypted else AuthenticatedSeal(key)


def _nonce_of(header: bytes) -> bytes:
    return header[_FLOW] + b"\0" + header[_LOOP] + header[_SEQUENCE]


def _require_length(key: bytes) -> None:
    if len(key) != KEY_BYTES:
        raise ValueError(f"the run's key has {KEY_BYTES} bytes, not {len(key)}")
