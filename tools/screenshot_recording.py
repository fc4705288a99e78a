"""Screenshot of a recording: rerun's web viewer in a headless Chromium, saved as a PNG.

    python tools/screenshot_recording.py recording.rrd picture.png --size 1600x1000

Needs Chromium or Chrome on the PATH, and only the standard library. It controls the browser by its
debugging protocol over a pipe, and takes the picture when it no longer changes.
"""

import argparse
import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from cosim.output.viewer.recording_viewer import RecordingServer
from netem.core.errors import CallerError, MachineError, NoackError
from netem.core.system_processes import python_command

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--hide-scrollbars",
    "--remote-debugging-pipe",
)
EMULATED_CARD = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""The viewer needs a graphics card. An emulated one also draws every page, at a high cost."""
# The browser reads its commands from descriptor 3 and writes its answers to descriptor 4.
PLACE_PIPES = """
import fcntl, os, sys
ends = [fcntl.fcntl(int(end), fcntl.F_DUPFD, 10) for end in sys.argv[1:3]]
os.dup2(ends[0], 3)
os.dup2(ends[1], 4)
os.execv(sys.argv[3], sys.argv[3:])
"""
POLL_S, SETTLE_S, LIMIT_S = 0.5, 2.5, 300.0


class Browser:
    """A headless browser, controlled by messages of the Chrome DevTools Protocol."""

    def __init__(self, program: str, profile: str, card: tuple[str, ...] = EMULATED_CARD) -> None:
        from_us, to_browser = os.pipe()
        from_browser, to_us = os.pipe()
        ends = [str(from_us), str(to_us)]
        self.process = subprocess.Popen(
            python_command("-c", PLACE_PIPES, *ends, program, *FLAGS, *card, f"--user-data-dir={profile}"),
            pass_fds=(from_us, to_us),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(from_us)
        os.close(to_us)
        self._out = os.fdopen(to_browser, "wb", buffering=0)
        self._in = os.fdopen(from_browser, "rb", buffering=0)
        self._buffer = b""
        self._numbers = itertools.count(1)
        self.session: str | None = None
        """The page that commands are for."""

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Send one command and return its result; other messages are skipped."""
        number = next(self._numbers)
        message: dict[str, Any] = {"id": number, "method": method, "params": parameters}
        if self.session is not None:
            message["sessionId"] = self.session
        self._out.write(json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == number:
                if "error" in answer:
                    raise MachineError(f"the browser refused {method}: {answer['error']}")
                result: dict[str, Any] = answer["result"]
                return result

    def open(self, url: str, width: int, height: int) -> None:
        """Open a page in a window of the given size in pixels."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self.session = session["sessionId"]
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        self.call("Page.navigate", url=url)

    def picture(self) -> bytes:
        """Return the page's present appearance as a PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def close(self) -> None:
        """End the browser."""
        self.process.terminate()
        self.process.wait()
        self._out.close()
        self._in.close()

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            block = os.read(self._in.fileno(), 1 << 16)
            if not block:
                raise MachineError("the browser ended unexpectedly")
            self._buffer += block
        line, _, self._buffer = self._buffer.partition(b"\0")
        message: dict[str, Any] = json.loads(line)
        return message


def take_picture(recording: Path, size: tuple[int, int], theme: str) -> bytes:
    """Show a recording in a headless browser and return the final page as a PNG.

    Raises:
        NoackError: the recording or the browser is missing, or the page does not settle.
    """
    if not recording.is_file():
        raise CallerError(f"{recording}: no such recording")
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        raise MachineError(f"no browser on the PATH; looked for {', '.join(BROWSERS)}")
    deadline = time.monotonic() + LIMIT_S
    with (
        RecordingServer(recording, follow=False) as server,
        tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile,
        contextlib.closing(Browser(program, profile)) as browser,
    ):
        browser.open(f"{server.start_page()}?theme={theme}&persist=0", *size)
        last = None
        while time.monotonic() < deadline:
            if server.downloaded.wait(POLL_S):
                time.sleep(SETTLE_S)
                picture = browser.picture()
                if picture == last:
                    return picture
                last = picture
    raise MachineError(f"the page was still loading or changing after {LIMIT_S:.0f} s")


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = map(int, text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT") from None
    return width, height


def main() -> int:
    """Run the command; return 0 when the picture is written."""
    parser = argparse.ArgumentParser(description="Save a picture of a recording.")
    parser.add_argument("recording", type=Path, metavar="RRD")
    parser.add_argument("picture", type=Path, metavar="PNG")
    parser.add_argument("--size", type=_size, default=(1600, 1000), metavar="WxH")
    parser.add_argument("--theme", choices=("dark", "light"), default="light")
    arguments = parser.parse_args()
    try:
        picture = take_picture(arguments.recording, arguments.size, arguments.theme)
        arguments.picture.write_bytes(picture)
    except (NoackError, OSError) as error:
        print(f"screenshot_recording: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
