"""Search the proofs of the shipped scenarios and of the README's servo again, and write the package's files.

``python tools/write_proofs.py [NAME ...]`` (``make proofs``). No search ends early: all take an hour. A file
whose bounds would grow by more than 3 % is kept, and the command fails.
"""

import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from pathlib import Path

ROOT = Path(__file__).parents[1]
MOST_GROWTH = 1.03
MOST_WORK = 400.0
"""Some problems are 17 · 10⁹ products per step of the solver: those of the F-16."""


def main() -> None:
    """Write the proofs of some scenarios, or of all."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder  # nothing was found before
        sys.exit(write_all(sys.argv[1:], Path(folder)))


def write_all(names: list[str], folder: Path) -> int:
    """Write proofs; return 1 if a bound grew."""
    from cosim.analysis import witness_store
    from cosim.analysis.witnesses import find_witnesses
    from netem.core.errors import CallerError

    shipped, found = witness_store.SHIPPED, folder / "noack" / "witnesses"
    shipped.mkdir(exist_ok=True)
    path = shipped / witness_store.INDEX
    witness_store.SHIPPED = folder / "none"  # so that all are searched
    has_grown = False
    for name, resolved in scenarios(names, folder):
        before, started = {*found.glob("*.json")}, time.process_time()
        try:
            find_witnesses(resolved, most_work=MOST_WORK)
        except CallerError as error:
            print(f"{name}: {error}", flush=True)
            continue
        index: dict[str, str] = json.loads(path.read_text()) if path.exists() else {}
        new = sorted({*found.glob("*.json")} - before, key=lambda each: each.stat().st_mtime_ns)
        for count, file in enumerate(new, 1):
            target = index.get(file.stem, f"{name}-{count}.json")
            has_grown |= not write(file, shipped / target)
            index[file.stem] = target
        path.write_text(json.dumps(dict(sorted(index.items(), key=lambda pair: pair[1])), indent=0) + "\n")
        print(f"{name}: {len(new)} proofs, {time.process_time() - started:.0f} s", flush=True)
    return int(has_grown)


def scenarios(names: list[str], folder: Path) -> Iterator[tuple[str, object]]:
    """Yield the resolved loops of scenarios with their names."""
    from cosim.shipped_files import find_shipped
    from noack.scenario.resolution import ResolvedRun
    from noack.scenario.scenario_file import load

    paths = [find_shipped(name, "scenarios") for name in names if name != "servo"]
    if not names:
        paths = sorted((ROOT / "scenarios").glob("*.toml"))
    if not names or "servo" in names:
        paths.append(servo(folder))
    for path in paths:
        for loop in ResolvedRun(load(path)).loops:
            own = path.stem if loop.name in (path.stem, None) else f"{path.stem}-{loop.name}"
            yield re.sub(r"[^\w-]", "_", own), loop


def servo(folder: Path) -> Path:
    """Return the scenario that the README's first commands make."""
    text = (ROOT / "README.md").read_text()
    program = re.search(r"```python\n(# servo\.py\n.*?)```", text, re.DOTALL)
    assert program is not None
    from netem.core.system_processes import python_command

    (folder / "servo.py").write_text(program[1])
    elsewhere = os.environ | {"XDG_CACHE_HOME": str(folder / "servo")}  # what it tries is no proof of it
    command = python_command("-m", "cosim.cli", "new", "servo.py")
    subprocess.run(command, cwd=folder, check=True, env=elsewhere)
    return folder / "servo.toml"


def write(found: Path, target: Path) -> bool:
    """Replace a proof unless a bound grew; return whether none did."""
    content = json.loads(found.read_text())
    if target.exists() and (larger := [*grown(json.loads(target.read_text()), content)]):
        print(f"{target.name} is kept: {'; '.join(larger)}", flush=True)
        return False
    target.write_text(json.dumps(content, allow_nan=False, separators=(",", ":")) + "\n")
    return True


def grown(old: Mapping[str, object], new: Mapping[str, object]) -> Iterator[str]:
    """Yield the outputs whose bound by forms grew, or is missing now."""
    before, after = sizes(old), sizes(new)
    for output, size in before.items():
        if after.get(output, math.inf) > MOST_GROWTH * size:
            yield f"{output}: {size:.6g} -> {after.get(output, math.inf):.6g}"


def sizes(content: Mapping[str, object]) -> Mapping[str, float]:
    """Return the bounds by forms of a stored search."""
    document = content["document"]
    bounds = document.get("bounds", []) if isinstance(document, dict) else []
    found = {}
    for bound in bounds:
        levels = [bound["numbers"].get(f"level {k}", 0.0) for k in (1, 2)]
        found[f"{bound['output']} {bound['from_start']}"] = math.sqrt(sum(levels))
    return found


if __name__ == "__main__":
    main()
