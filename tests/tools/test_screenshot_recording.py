"""Check the recording on a screenshot of the viewer in a browser."""

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import noack
from cosim.output import palette
from tools.screenshot_recording import BROWSERS

TOOL = Path(__file__).parents[2] / "tools" / "screenshot_recording.py"
CAR, SENSOR, CONTROLLER = palette.PLANT, palette.SENSOR, palette.CONTROLLER


@pytest.mark.timeout(400)
@pytest.mark.skipif(
    not any(map(shutil.which, BROWSERS)), reason="there is no Chromium or Chrome on the PATH"
)
def test_a_recording_shows_the_car_and_the_position_in_each_model(tmp_path: Path) -> None:
    run = noack.simulate(noack.load("lane_following", {"horizon_s": 8.0}), runs=tmp_path)
    picture = tmp_path / "run.png"
    done = subprocess.run(
        [
            sys.executable, str(TOOL),
            str(run.directory / "recording.rrd"), str(picture),
            "--size", "1200x800", "--theme", "light",
        ],
        capture_output=True, text=True, timeout=330, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    image = Image.open(picture).convert("RGB")
    assert image.size == (1200, 800)
    # The left half of the window: the car on its lane at the top, packets and text below.
    lane = image.crop((0, 60, 440, 330))  # without the text on the right
    car, sensor, controller = (near(lane, colour) for colour in (CAR, SENSOR, CONTROLLER))
    assert len(car) > 2000  # the car's body
    assert len(sensor) > 150  # outline only
    assert len(controller) > 150
    # The view opens at a time when losses make the controller's model differ.
    middles = {name: np.median(found, axis=0) for name, found in
               (("car", car), ("sensor", sensor), ("controller", controller))}  # fmt: skip
    assert np.linalg.norm(middles["sensor"] - middles["car"]) < 10
    assert np.linalg.norm(middles["controller"] - middles["car"]) > 10
    curves = image.crop((600, 60, 1200, 390))
    assert len(near(curves, SENSOR)) > 300
    assert len(near(curves, CONTROLLER)) > 300


def near(image: Image.Image, colour: palette.Colour) -> Any:
    """Return the positions (k, 2) of pixels of this colour, with a tolerance for smoothed edges."""
    pixels = np.asarray(image, dtype=int)
    return np.argwhere(np.abs(pixels - colour).max(axis=2) < 20)
