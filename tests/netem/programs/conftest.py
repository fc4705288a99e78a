"""Emulators for real programs, each in a separate process."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from tests.netem.programs.emulator import Emulator

Emulate = Callable[..., Emulator]


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Emulate]:
    """Start emulators; kill the remaining ones at the end."""
    started: list[Emulator] = []

    def start(
        to: str, *words: str, listen: str = "127.0.0.1:0", inside: Sequence[str] = ()
    ) -> Emulator:
        folder = tmp_path / f"emulator {len(started)}"
        folder.mkdir()
        emulator = Emulator(folder, to, *words, listen=listen, inside=inside)
        started.append(emulator)
        return emulator

    yield start
    for emulator in started:
        emulator.kill()
