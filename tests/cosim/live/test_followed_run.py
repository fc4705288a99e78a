"""noack.follow, where there is nothing to follow."""

from pathlib import Path

import pytest

import noack
from netem.core.errors import CallerError


def test_a_run_that_is_not_active_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CallerError, match="no run is active"):
        noack.follow(tmp_path, timeout_s=0.0)
