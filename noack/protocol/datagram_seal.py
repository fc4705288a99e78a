"""Tags by keyed BLAKE2b, and encrypted datagrams of the loop.

The datagrams of the loop that are not encrypted get their tags in the core (native/wire.c).
"""

import hashlib

KEY_BYTES = 32
TAG_BYTES = 16
_FLOW, _LOOP, _SEQUENCE = slice(3, 4), slice(6, 8), slice(16, 24)  # in the header
_PURPOSE = b"noack datagrams"


class Tagger:
    """Computes the tag of a message of another kind than the loop's; keying is done once."""

    def __init__(self, key: bytes) -> None:
        require_key(key)
        self._keyed = hashlib.blake2b(key=key, digest_size=TAG_BYTES)

    def __call__(self, content: bytes) -> bytes:
        """Return the tag."""
        state = self._keyed.copy()
        state.update(content)
        return state.digest()


class EncryptedSeal:
    """Layout version 2: the vector encrypted by ChaCha20-Poly1305 (RFC 8439), with its tag.

    The tag covers the header, too, which is readable. Nobody without the key can change, make or
    read what is encrypted.

    The nonce is the flow, the loop and the sequence number. No two datagrams of a run have the same
    ones: a restarted process numbers its messages above all of its predecessor's.
    """

    version = 2

    def __init__(self, key: bytes) -> None:
        # Loaded here, since few runs are encrypted.
        from cryptography.exceptions import InvalidTag
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

        require_key(key)
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


def _nonce_of(header: bytes) -> bytes:
    return header[_FLOW] + b"\0" + header[_LOOP] + header[_SEQUENCE]


def require_key(key: bytes) -> None:
    """Raise ValueError if a key has another length."""
    if len(key) != KEY_BYTES:
        raise ValueError(f"the run's key has {KEY_BYTES} bytes, not {len(key)}")
