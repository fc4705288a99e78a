"""Another user at the web viewer's ports can neither read nor replace the recording."""

import http.client
import socket
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest

from cosim.output.viewer.recording_viewer import RECORDING, RecordingServer
from cosim.output.viewer.rerun_program import HOST
from tests.attacks.other_user import as_another_user, needs_root, output_of_another_user

THEIR_SERVER = """
class Handler(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200); self.end_headers(); self.wfile.write(b"theirs")
    def log_message(self, *_): pass
server = http.server.HTTPServer(("127.0.0.1", int(sys.argv[1])), Handler)
print(server.server_port, flush=True)
server.serve_forever()
"""
CONTENT = b"RRF2 and more"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RecordingServer]:
    path = tmp_path_factory.mktemp("served") / "recording.rrd"
    path.write_bytes(CONTENT)
    with RecordingServer(path, follow=False) as serving:
        serving.start_page()
        yield serving


def secret_of(server: RecordingServer) -> str:
    return urlsplit(server.address).path.strip("/")


def ask(url: str, host: str | None = None) -> tuple[int, http.client.HTTPMessage, bytes]:
    """Send a request without following redirections or normalising the path."""
    parts = urlsplit(url)
    target = url.removeprefix(f"{parts.scheme}://{parts.netloc}")
    with socket.create_connection((str(parts.hostname), parts.port)) as connection:
        connection.sendall(f"GET {target} HTTP/1.1\r\nHost: {host or parts.netloc}\r\n\r\n".encode("latin-1"))
        answer = http.client.HTTPResponse(connection)
        with closing(answer):
            answer.begin()
            return answer.status, answer.headers, answer.read()


def test_only_the_printed_address_serves_the_page(server: RecordingServer) -> None:
    """Through a forwarded port, too; and the browser sends no referrer."""
    address = server.address
    for host in (None, "localhost:4000"):
        status, headers, _ = ask(f"{address}?theme=light", host)
        assert status == 302
        query = parse_qs(urlsplit(headers["Location"]).query)
        (url,) = query["url"]
        origin = server.origin if host is None else f"http://{host}"
        assert url == address.replace(server.origin, origin) + RECORDING
        assert query["theme"] == ["light"]
    status, _, page = ask(server.origin + headers["Location"])
    assert status == 200
    assert b"re_viewer.js" in page
    assert ask(address + "re_viewer.js")[0] == 200
    assert ask(address + RECORDING)[::2] == (200, CONTENT)
    for path in (address, f"{address}?url=x", address + RECORDING, f"{server.origin}/"):
        assert ask(path)[1]["Referrer-Policy"] == "no-referrer"
    assert ask(address + RECORDING, "rebound.example:1")[0] == 403
    assert ask(address + "../recording.rrd")[0] == 404


def test_without_the_exact_secret_every_path_is_404(server: RecordingServer) -> None:
    secret = secret_of(server)
    similar = (secret[:-1], f"{secret}x", secret.swapcase(), "", "x", "%2e")
    for path in (*(f"{text}/" for text in similar), secret):
        for name in ("", RECORDING, "re_viewer.js"):
            assert ask(f"{server.origin}/{path}{name}")[0] == 404


def test_the_secret_is_new_each_time_long_and_on_no_command_line(server: RecordingServer) -> None:
    with RecordingServer(server.path, follow=False) as other:
        secrets = {secret_of(server), secret_of(other)}
    assert len(secrets) == 2
    assert all(len(secret) >= 43 for secret in secrets)  # 256 bits in base64
    lines = []
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):  # one that has ended, also of an earlier test
            lines.append(" ".join(child.cmdline()))
    assert any("--serve-web" in line for line in lines)
    assert not any(secret_of(server) in line for line in lines)


def test_an_invalid_path_gets_status_400(server: RecordingServer, capfd: pytest.CaptureFixture[str]) -> None:
    for prefix in (f"{server.origin}/", server.address):
        for path in ("\xe9", "\x01", "\x7f", "?\xe9"):
            assert ask(prefix + path)[0] == 400
    assert capfd.readouterr().err == ""


@needs_root
def test_another_user_cannot_bind_reruns_port(server: RecordingServer) -> None:
    """The port is bound as it is chosen."""
    assert server.web_viewer is not None
    code = """
import socket
for host in ("127.0.0.1", "0.0.0.0"):
    with socket.socket() as second:
        second.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        second.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        try:
            second.bind((host, int(sys.argv[1])))
            second.listen()
            print("bound")
        except OSError as error:
            print("refused")
"""
    assert output_of_another_user(code, str(server.web_viewer.port)) == "refused\nrefused"


@needs_root
def test_an_answer_of_another_users_program_is_refused_once_rerun_has_ended(
    tmp_path: Path,
) -> None:
    (tmp_path / "recording.rrd").write_bytes(CONTENT)
    with RecordingServer(tmp_path / "recording.rrd", follow=False) as server:
        server.start_page()
        viewer = server.web_viewer
        assert viewer is not None
        viewer.process.kill()
        viewer.process.wait()
        with as_another_user(THEIR_SERVER, str(viewer.port)) as theirs:
            assert theirs.stdout is not None
            assert int(theirs.stdout.readline()) == viewer.port
            assert ask(f"http://{HOST}:{viewer.port}/")[2] == b"theirs"
            for name in ("?url=x", "re_viewer.js"):
                status, _, body = ask(server.address + name)
                assert status == 502
                assert b"theirs" not in body


def test_the_page_ends_with_the_rerun_program(server: RecordingServer) -> None:
    """Also if another program of this user binds the same port."""
    address, viewer = server.address, server.web_viewer
    assert viewer is not None
    viewer.process.kill()
    viewer.process.wait()
    assert ask(address + "re_viewer.js")[0] == 502
    with RecordingServer(server.path, follow=False) as other:
        viewer.port = int(other.origin.rpartition(":")[2])
        assert ask(address + "re_viewer.js")[0] == 502
    assert ask(address + RECORDING)[::2] == (200, CONTENT)
