"""The web viewer's files, which rerun's program contains and serves on a port of its own.

Any user of the machine could listen on that port once the program has ended. So the port is the
one that the kernel gave to the program, and an answer is used only if it comes from a process of
this user.
"""

import contextlib
import http.client
import os
import re
import tempfile
import time
from collections.abc import Iterator

from cosim.viewer.peer_user import peer_user
from cosim.viewer.rerun_program import end_process, start_rerun
from noack.errors import MachineError, PeerError

HOST = "127.0.0.1"

_START_S = 10.0
_TIMEOUT_S = 10.0
_POLL_S = 0.02
_SERVED_AT = re.compile(rb"(?<!\+)http://127\.0\.0\.1:(\d+)")


class WebViewer:
    """Serves the web viewer's files while it lasts.

    Raises:
        MachineError: rerun's program does not start.
    """

    def __init__(self) -> None:
        # Named a recording that a page can load by itself, the program serves the page and no
        # more; named a file it spins, and named nothing it opens another port for data. The page
        # is told elsewhere where the recording is: everybody can read a command line.
        arguments = ["--serve-web", "--bind", HOST, "--web-viewer-port", "0"]
        with tempfile.TemporaryFile() as output:
            self.process = start_rerun([*arguments, f"http://{HOST}/recording.rrd"], output=output)
            deadline_s = time.monotonic() + _START_S
            while self.process.poll() is None and time.monotonic() < deadline_s:
                if found := _SERVED_AT.search(os.pread(output.fileno(), 1 << 16, 0)):
                    self.port = int(found[1])
                    return
                time.sleep(_POLL_S)
        self.close()
        raise MachineError("rerun's web viewer did not start")

    @contextlib.contextmanager
    def file(self, name: str) -> Iterator[http.client.HTTPResponse]:
        """Give the answer to a request for a file, while the context lasts.

        Raises:
            PeerError: the program has ended, or what answers is not a process of this user.
        """
        source = http.client.HTTPConnection(HOST, self.port, timeout=_TIMEOUT_S)
        with contextlib.closing(source):
            try:
                source.connect()
                connection = source.sock
                source.request("GET", f"/{name}")
                answer = source.getresponse()
            except (OSError, http.client.HTTPException):
                raise PeerError("rerun's web viewer does not answer") from None
            # Asked now, as a connection has no user before it is accepted. The answer comes over
            # this very connection, whoever may listen on the port meanwhile.
            if self.process.poll() is not None or peer_user(connection) != os.getuid():
                raise PeerError("rerun's web viewer has ended, or another user's program answers")
            yield answer

    def close(self) -> None:
        """End the program."""
        end_process(self.process)
