"""Keys and certificates for the control plane of one run, across hosts.

An authority signs one certificate for the coordinator and one for all that join; its own key is
forgotten. Each end accepts only the other one's certificate.
"""

import datetime
import ipaddress
import ssl
from collections.abc import Sequence
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from noack.runtime.coordinator_link import tls_context

_VALID = datetime.timedelta(days=3650)
"""A run may be long, and the hosts' dates may differ; an invitation ends by its pass."""


class KeyPair(NamedTuple):
    """A certificate and its private key, as PEM text."""

    certificate: str
    private_key: str


class TlsKeys(NamedTuple):
    """The keys of one run."""

    authority: str  # its certificate
    coordinator: KeyPair
    joining: KeyPair


def new_tls_keys(host: str) -> TlsKeys:
    """Return keys for a coordinator at a numeric address."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name("noack run")
    authority = (
        _builder(name, name, key.public_key())
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    addresses = [x509.IPAddress(ipaddress.ip_address(host))]
    joining = [x509.DNSName("joining")]
    return TlsKeys(
        _pem(authority),
        _signed("coordinator", addresses, ExtendedKeyUsageOID.SERVER_AUTH, name, key),
        _signed("joining", joining, ExtendedKeyUsageOID.CLIENT_AUTH, name, key),
    )


def _signed(
    who: str,
    subjects: Sequence[x509.GeneralName],
    usage: x509.ObjectIdentifier,
    issuer: x509.Name,
    authority: ec.EllipticCurvePrivateKey,
) -> KeyPair:
    key = ec.generate_private_key(ec.SECP256R1())
    certificate = (
        _builder(_name(who), issuer, key.public_key())
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(subjects), critical=False)
        .add_extension(x509.ExtendedKeyUsage([usage]), critical=False)
        .sign(authority, hashes.SHA256())
    )
    private = key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )
    return KeyPair(_pem(certificate), private.decode())


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _VALID)
        .not_valid_after(now + _VALID)
    )


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _pem(certificate: x509.Certificate) -> str:
    return certificate.public_bytes(serialization.Encoding.PEM).decode()


def coordinator_context(keys: TlsKeys) -> ssl.SSLContext:
    """Return the TLS settings of the coordinator's end."""
    return tls_context(keys.authority, *keys.coordinator, server=True)
