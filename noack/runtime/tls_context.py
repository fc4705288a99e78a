"""TLS settings of both ends of the control plane between hosts: TLS 1.3, both have certificates."""

import os
import ssl
from collections.abc import Iterator
from contextlib import contextmanager


def tls_context(
    authority: str, certificate: str, private_key: str, *, server: bool
) -> ssl.SSLContext:
    """Return the settings of one end, which accepts only the other end's certificate.

    Args:
        authority: the certificate that signed both, as PEM text.
        certificate: of this end, as PEM text.
        private_key: of this end, as PEM text.
        server: whether this end is the coordinator.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if server else ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    context.verify_mode = ssl.CERT_REQUIRED
    context.load_verify_locations(cadata=authority)
    with _file_in_memory(private_key + certificate) as path:
        context.load_cert_chain(path)
    return context


@contextmanager
def _file_in_memory(secret: str) -> Iterator[str]:
    """Give the path of a file with a text: ssl reads files only."""
    descriptor = os.memfd_create("tls", os.MFD_CLOEXEC)
    with os.fdopen(descriptor, "w") as file:
        file.write(secret)
        file.flush()
        yield f"/proc/self/fd/{descriptor}"
