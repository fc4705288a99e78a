"""The recording is looked at, in a browser, as a person would."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

from tests.integration.conftest import run_scenario, settings

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_a_runs_recording_is_a_picture_of_its_states(tmp_path: Path) -> None:
    finished = run_scenario(tmp_path, *settings(speed=5.0, horizon_s=10.0))
    picture = tmp_path / "run.png"
    done = subprocess.run(
        [
            sys.executable, str(ROOT / "tools" / "screenshot_recording.py"),
            str(finished.run_dir / "recording.rrd"), str(picture), "--size", "1200x800",
        ],
        capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    image = Image.open(picture).convert("RGB")
    assert image.size == (1200, 800)
    # An empty recording has 0 and some 250 of these, the play bar and the warnings of the viewer.
    colours = {colour: count for count, colour in image.getcolors(1 << 24)}
    blue = sum(n for (r, g, b), n in colours.items() if b > 200 and r < 90)
    orange = sum(n for (r, g, b), n in colours.items() if r > 200 and 90 < g < 180 and b < 80)
    assert blue > 2000
    assert orange > 2000
