"""``python -m tests.fuzz run|show``: fuzz each parser in a process; show one input as a line."""

import argparse
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

from tests.fuzz.harness import FOLDER, kept_inputs, parsers, to_line
from tests.native import sanitized_core

ROOT = FOLDER.parents[1]
OUT = ROOT / ".cache" / "fuzz"
"""Findings of runs, and their corpora for the next run."""
_STATUS = re.compile(rb"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+)")
_FLAGS = ("-timeout=60", "-rss_limit_mb=3000", "-max_len=8192", "-verbosity=1")
_FINDINGS = ("crash-", "oom-", "timeout-")
"""Prefixes of the files with an input that causes a failure."""


def fuzz(name: str, seconds: int) -> tuple[bool, str]:
    """Fuzz a parser; return whether it failed, and lines that say how the run went."""
    under_test = parsers()[name]
    folder, corpus = OUT / name, OUT / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for old in _findings_in(folder):
        old.replace(corpus / old.name)  # try old findings first
    for number, data in enumerate([*under_test.seeds, *kept_inputs(name)]):
        (corpus / f"kept-{number}").write_bytes(data)
    words, log = folder / "words.dict", folder / "log.txt"
    lines = ('"' + "".join(f"\\x{byte:02x}" for byte in word) + '"' for word in under_test.words)
    words.write_text("\n".join(dict.fromkeys(lines)) + "\n", encoding="ascii")
    until = f"-max_total_time={seconds}"
    flags = [str(corpus), until, *_FLAGS, f"-artifact_prefix={folder}/", f"-dict={words}"]
    child = [sys.executable, "-m", "tests.fuzz.child", name, *flags]
    environment: Mapping[str, str] = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    if under_test.sanitized:
        with suppress(sanitized_core.NoSanitizersError):
            child, environment = sanitized_core.command("tests.fuzz.random_child", name, *flags)
    with log.open("wb") as file:
        result = subprocess.run(child, cwd=ROOT, stdout=file, stderr=file, check=False, env=environment)
    statuses = _STATUS.findall(log.read_bytes())
    executions, _, features = map(int, statuses[-1]) if statuses else (0, 0, 0)
    findings = _findings_in(folder)
    is_bad = bool(findings or result.returncode or not executions)
    outcome = f"status {result.returncode}, see {log}" if is_bad else "no finding"
    shown = [f"    python -m tests.fuzz show {name} {path.relative_to(ROOT)}" for path in findings]
    report = f"  {name}: {executions:,} executions, {features:,} features, {outcome}"
    return is_bad, "\n".join([report, *shown])


def _findings_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.name.startswith(_FINDINGS))


def main() -> int:
    """Return 0, or 1 if a parser fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    commands = parser.add_subparsers(required=True, dest="command")
    run = commands.add_parser("run", help="fuzz; exit status 1 if something was found")
    run.add_argument("--minutes", type=float, default=10.0, help="of wall time, for all (10)")
    run.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="parsers at a time")
    run.add_argument("names", nargs="*", metavar="PARSER", help=f"of {', '.join(parsers())}")
    show = commands.add_parser("show", help="run one input again")
    show.add_argument("name", choices=parsers())
    show.add_argument("file", type=Path)
    options = parser.parse_args()
    if options.command == "show":
        data = options.file.read_bytes()
        print(to_line(data))
        parsers()[options.name].run(data)
        print("nothing is wrong with this")
        return 0
    names = options.names or parsers()
    if wrong := set(names) - set(parsers()):
        parser.error(f"no such parser: {', '.join(sorted(wrong))}; there are {', '.join(parsers())}")
    if importlib.util.find_spec("atheris") is None:
        print("the fuzzer, atheris, is not installed; it has wheels for Linux and few Pythons")
        return 2
    seconds = max(round(60 * options.minutes * options.jobs / len(names)), 1)
    print(f"{len(names)} parsers, {seconds} s each, {options.jobs} at a time", flush=True)
    bad = 0
    with ThreadPoolExecutor(options.jobs) as pool:
        for is_bad, report in pool.map(lambda name: fuzz(name, seconds), names):
            bad += is_bad
            print(report, flush=True)
    print(f"{bad} of {len(names)} parsers failed")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
