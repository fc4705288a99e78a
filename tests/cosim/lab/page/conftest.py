"""The page, served for all tests of a file, and a headless browser for each test."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.integration import conftest as live
from tools.screenshot_recording import Browser


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("lab")


@pytest.fixture(scope="module")
def address(folder: Path) -> Iterator[str]:
    command = live.noack_command("lab", "--no-browser", "--json", "--set", "horizon_s=4")
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            text = "".join(iter(server.stdout.readline, "}\n")) + "}"
            yield json.loads(text)["address"]
        finally:
            server.send_signal(signal.SIGINT)
            assert server.wait(timeout=live.PATIENCE_S) in (0, 130)


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Browser]:
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None or sys.platform != "linux" or not hasattr(os, "fork"):
        pytest.skip("no chromium here")
    started = Browser(program, str(tmp_path))
    try:
        yield started
    finally:
        started.close()
