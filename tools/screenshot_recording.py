"""Screenshot of a recording: rerun's web viewer in a headless Chromium, saved as a PNG.

    python tools/screenshot_recording.py recording.rrd picture.png --size 1600x1000

Needs Chromium or Chrome on the PATH. The picture is taken when it no longer changes.
"""

import argparse
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from playwright.sync_api import Browser, Error, sync_playwright

from cosim.output.viewer.recording_viewer import RecordingServer
from netem.core.errors import CallerError, MachineError, NoackError

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
EMULATED_CARD = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
"""The viewer needs a graphics card. An emulated one also draws every page, at a high cost."""
POLL_S, SETTLE_S, LIMIT_S = 0.5, 2.5, 300.0


@contextmanager
def headless_browser(*flags: str) -> Iterator[Browser]:
    """Run the machine's Chromium without a window within the context.

    Raises:
        MachineError: there is none.
    """
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    if program is None:
        raise MachineError(f"no browser on the PATH; looked for {', '.join(PROGRAMS)}")
    with sync_playwright() as playwright:
        arguments = [*FLAGS, *flags]
        browser = playwright.chromium.launch(executable_path=program, args=arguments, chromium_sandbox=False)
        yield browser
        browser.close()


def take_picture(recording: Path, size: tuple[int, int], theme: str) -> bytes:
    """Show a recording in a headless browser and return the final page as a PNG.

    Raises:
        NoackError: the recording or the browser is missing, or the page does not settle.
    """
    if not recording.is_file():
        raise CallerError(f"{recording}: no such recording")
    deadline_s = time.monotonic() + LIMIT_S
    with RecordingServer(recording, follow=False) as server, headless_browser(*EMULATED_CARD) as browser:
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.goto(f"{server.start_page()}?theme={theme}&persist=0")
        last = None
        while time.monotonic() < deadline_s:
            if server.downloaded.wait(POLL_S):
                page.wait_for_timeout(1e3 * SETTLE_S)
                picture = page.screenshot(timeout=1e3 * LIMIT_S)
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
    except (NoackError, OSError, Error) as error:
        print(f"screenshot_recording: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
