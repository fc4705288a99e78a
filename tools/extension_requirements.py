"""Print what the extensions, or those named, and their tests need besides noack, for ``make lock``."""

import sys
import tomllib
from pathlib import Path

for path in sorted(Path("extensions").glob("*/pyproject.toml")):
    if sys.argv[1:] and path.parent.name not in sys.argv[1:]:
        continue
    content = tomllib.loads(path.read_text(encoding="utf-8"))
    project, groups = content["project"], content.get("dependency-groups", {})
    extras = project.get("optional-dependencies", {})
    for needed in (project["dependencies"], *extras.values(), *groups.values()):
        print(*(text for text in needed if text != "noack"), sep="\n")
