"""A process that shows where it runs."""

import json
import os
from collections.abc import Sequence
from pathlib import Path


def main(_arguments: Sequence[str]) -> int:
    """Print the folder and the environment; return the exit status."""
    print(json.dumps({"folder": str(Path.cwd()), "environment": dict(os.environ)}))
    return 0
