"""QUIC delivers its content unchanged through all impairments together."""

import asyncio
import datetime
from pathlib import Path

import numpy as np
import pytest
from aioquic.asyncio import connect, serve
from aioquic.quic.configuration import QuicConfiguration
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from tests.netem.conftest import Emulate
from tests.netem.programs.ports import HOST, open_server

WORDS = "delay 5ms 2ms loss 5% reorder 5% duplicate 2% corrupt 1% mansd 3 seed 1"
CONTENT_BYTES = 300_000
PATIENCE_S = 60.0


@pytest.fixture
def certificate(tmp_path: Path) -> tuple[Path, Path]:
    """A self-signed certificate for localhost and its key."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
    now = datetime.datetime.now(datetime.UTC)
    signed = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))
        .not_valid_after(now + datetime.timedelta(days=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    files = tmp_path / "certificate.pem", tmp_path / "key.pem"
    files[0].write_bytes(signed.public_bytes(serialization.Encoding.PEM))
    files[1].write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    return files


def test_content_arrives_unchanged_in_both_directions(
    emulate: Emulate, certificate: tuple[Path, Path]
) -> None:
    content = np.random.default_rng(0).bytes(CONTENT_BYTES)
    received: list[bytes] = []

    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        received.append(await reader.read())
        writer.write(received[-1][::-1])
        writer.write_eof()

    async def ask(host: str, port: int) -> bytes:
        trusting = QuicConfiguration(is_client=True, server_name="localhost")
        trusting.load_verify_locations(str(certificate[0]))
        async with connect(host, port, configuration=trusting) as client:
            reader, writer = await client.create_stream()
            writer.write(content)
            writer.write_eof()
            return await reader.read()

    async def go() -> tuple[bytes, dict[str, dict[str, object]]]:
        own = QuicConfiguration(is_client=False)
        own.load_cert_chain(*certificate)
        tasks: list[asyncio.Future[None]] = []
        server, port = await open_server(
            lambda port: serve(
                HOST, port, configuration=own,
                stream_handler=lambda *ends: tasks.append(asyncio.ensure_future(echo(*ends))),
            )
        )  # fmt: skip
        emulator = emulate(f"{HOST}:{port}", "--both", WORDS)
        try:
            answer = await asyncio.wait_for(ask(emulator.host, emulator.port), PATIENCE_S)
        finally:
            server.close()
        return answer, emulator.finish()

    answer, link = asyncio.run(go())
    assert received == [content]
    assert answer == content[::-1]
    for direction in ("forward", "reverse"):
        of = link[direction]
        assert of["received_bytes"] > CONTENT_BYTES
        assert of["fates"]["dropped"] > 0
        assert of["fates"]["corrupted"] > 0
        assert of["duplicated"] > 0
        assert of["delivered_out_of_order"] > 0
        assert of["longest_loss_burst"] <= 3
