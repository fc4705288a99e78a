"""A certificate authority for one run, whose private key is nowhere but in this process."""

import datetime
import ipaddress

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

_BEFORE = datetime.timedelta(hours=1)
"""Certificates are valid from so long before, as clocks differ."""


class CertificateAuthority:
    """A certificate authority; its certificates are valid for ``valid`` from now on."""

    def __init__(self, valid: datetime.timedelta) -> None:
        now = datetime.datetime.now(datetime.UTC)
        self._from, self._until = now - _BEFORE, now + valid
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = _name("noack run")
        builder = self._builder(self._name, self._key)
        constraints = x509.BasicConstraints(ca=True, path_length=0)
        self.certificate = self._signed(builder.add_extension(constraints, critical=True))
        """Its own, as PEM text."""

    def key_pair(self, role: str, address: str | None = None) -> tuple[bytes, bytes]:
        """Return a new certificate and its private key, as PEM text; the common name is the role.

        The certificate is for a host of this address, or for the role.
        """
        owner: x509.GeneralName = x509.DNSName(role)
        if address is not None:
            owner = x509.IPAddress(ipaddress.ip_address(address))
        key = ec.generate_private_key(ec.SECP256R1())
        builder = self._builder(_name(role), key)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(x509.SubjectAlternativeName([owner]), critical=False)
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        return self._signed(builder), private

    def _builder(self, subject: x509.Name, key: ec.EllipticCurvePrivateKey) -> x509.CertificateBuilder:
        number = x509.random_serial_number()
        builder = x509.CertificateBuilder(self._name, subject, key.public_key(), number)
        return builder.not_valid_before(self._from).not_valid_after(self._until)

    def _signed(self, builder: x509.CertificateBuilder) -> bytes:
        return builder.sign(self._key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])
