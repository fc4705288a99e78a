"""The long run: fuzz each parser in a separate process and print a report at the end."""

import os
import re
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.harness import FOLDER, Harness, harness, kept

ROOT = FOLDER.parents[1]
OUT = ROOT / ".cache" / "fuzz"
"""Findings of runs, and their corpora for the next run."""
BIN = ".venv/bin"
_STATUS = re.compile(rb"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+)")
_INPUT_TIMEOUT_S = 60
_MEMORY_MIB = 3000
_LONGEST_INPUT = 8192
_ARTIFACTS = ("crash-", "oom-", "timeout-")
FINDINGS = ("finding-", *_ARTIFACTS)
"""Prefixes of the files with an input that causes a failure."""


@dataclass(frozen=True)
class Result:
    """The result of fuzzing a parser."""

    name: str
    executions: int
    features: int
    """The fuzzer's coverage features: branches and how often they are taken."""
    wall_s: float
    findings: Sequence[Path]
    """Files with inputs that cause a failure."""
    failed: str | None
    """Why the fuzzer itself ended early, or None."""


def fuzz(name: str, until: str, out: Path = OUT) -> Result:
    """Fuzz a parser.

    Args:
        name: the parser.
        until: the fuzzer's flag that limits the run.
        out: the parent folder of the corpus and the findings.
    """
    under_test = harness(name)
    folder, corpus = out / name, out / name / "corpus"
    corpus.mkdir(parents=True, exist_ok=True)
    for old in (path for path in folder.iterdir() if path.is_file()):
        if old.name.startswith(FINDINGS) and not old.suffix:
            old.replace(corpus / old.name)  # try old findings first
        else:
            old.unlink()
    for number, data in enumerate([*under_test.seeds, *kept(name)]):
        (corpus / f"kept-{number}").write_bytes(data)
    flags = [
        str(corpus), until, f"-timeout={_INPUT_TIMEOUT_S}",
        f"-rss_limit_mb={_MEMORY_MIB}", f"-max_len={_LONGEST_INPUT}",
        f"-artifact_prefix={folder}/", "-print_final_stats=0", "-verbosity=1",
    ]  # fmt: skip
    if under_test.words:
        flags.append(f"-dict={_dictionary(under_test, folder)}")
    began_s = time.monotonic()
    log = folder / "log.txt"
    with log.open("wb") as file:
        status = subprocess.run(
            [sys.executable, "-m", "tests.fuzz.child", name, str(folder), *flags],
            cwd=ROOT, stdout=file, stderr=file, check=False,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        ).returncode  # fmt: skip
    found = _STATUS.findall(log.read_bytes())
    executions, _, features = map(int, found[-1]) if found else (0, 0, 0)
    findings = sorted(
        path for path in folder.iterdir()
        if path.name.startswith(FINDINGS) and not path.suffix
    )  # fmt: skip
    failed = None
    if status and not any(path.name.startswith(_ARTIFACTS) for path in findings):
        failed = f"the fuzzer ended with status {status}; see {log}"
    elif not executions:
        failed = f"the fuzzer ran nothing; see {log}"
    return Result(name, executions, features, time.monotonic() - began_s, findings, failed)


def fuzz_all(names: Sequence[str], minutes: float, jobs: int) -> int:
    """Fuzz ``jobs`` parsers at a time; print the findings; return the number of failed parsers."""
    seconds = max(round(60 * minutes * jobs / len(names)), 1)
    print(f"{len(names)} parsers, {seconds} s each, {jobs} at a time", flush=True)
    results: list[Result] = []
    with ThreadPoolExecutor(jobs) as pool:
        for result in pool.map(lambda name: fuzz(name, f"-max_total_time={seconds}"), names):
            results.append(result)
            print(f"  [{len(results)}/{len(names)}] {_line(result)}", flush=True)
    bad = [result for result in results if result.findings or result.failed]
    print(f"\n{'parser':<12}{'executions':>12}{'features':>10}{'findings':>10}")
    for result in results:
        print(
            f"{result.name:<12}{result.executions:>12,}{result.features:>10,}"
            f"{len(result.findings):>10}"
        )
    for result in bad:
        if result.failed:
            print(f"\n{result.name}: {result.failed}")
        for path in result.findings:
            print(f"\n{result.name}: {_last_line(path)}\n  {_reproduce(result.name, path)}")
    executions = sum(result.executions for result in results)
    print(f"\n{executions:,} executions, {sum(len(r.findings) for r in results)} findings")
    return len(bad)


def _line(result: Result) -> str:
    found = f"{len(result.findings)} findings" if result.findings else "nothing found"
    return (
        f"{result.name}: {result.failed or found}, {result.executions:,} executions, "
        f"{result.features:,} features, {result.wall_s:.0f} s"
    )


def _last_line(path: Path) -> str:
    said = path.with_suffix(".txt")
    if not said.is_file():
        return path.name.partition("-")[0]
    return (said.read_text(encoding="utf-8").strip().splitlines() or [""])[-1][:200]


def _reproduce(name: str, path: Path) -> str:
    return f"{BIN}/python -m tests.fuzz show {name} {path.relative_to(ROOT)}"


def _dictionary(under_test: Harness, folder: Path) -> Path:
    path = folder / "words.dict"
    lines = ('"' + "".join(f"\\x{byte:02x}" for byte in word) + '"' for word in under_test.words)
    path.write_text("\n".join(dict.fromkeys(lines)) + "\n", encoding="ascii")
    return path
