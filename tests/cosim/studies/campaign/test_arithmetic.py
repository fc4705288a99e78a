"""What the digest of the code covers."""

import subprocess
import sys
from pathlib import Path

from cosim.studies.campaign import arithmetic


def test_the_digest_of_the_code_has_every_package_that_a_run_imports() -> None:
    script = "import sys, cosim.simulation.sampled_loop, cosim.simulation.virtual_time; print(*sys.modules)"
    imported = subprocess.check_output([sys.executable, "-c", script], text=True).split()
    packages = {name.partition(".")[0] for name in imported}
    root = Path(arithmetic.__file__).parents[3]
    own = {path.parent.name for path in root.glob("*/__init__.py")} & packages
    assert {"noack", "plant_server"} <= own == {*arithmetic._CODE}
