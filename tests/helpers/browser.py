"""A headless browser for tests."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from playwright.sync_api import Browser

from netem.core.errors import MachineError
from tools.screenshot_recording import headless_browser


@contextmanager
def started() -> Iterator[Browser]:
    """Run a headless browser within the context; skip the test if there is none."""
    try:
        with headless_browser() as browser:
            yield browser
    except MachineError as error:
        pytest.skip(str(error))
