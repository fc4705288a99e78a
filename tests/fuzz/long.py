"""The long run: fuzz each parser in a separate process and report its findings."""

import os
import re
import subprocess
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.harness import FOLDER, harness, kept
from tests.native import sanitized_core

ROOT = FOLDER.parents[1]
OUT = ROOT / ".cache" / "fuzz"
"""Findings of runs, and their corpora for the next run."""
_STATUS = re.compile(rb"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+)")
_FLAGS = ("-timeout=60", "-rss_limit_mb=3000", "-max_len=8192", "-verbosity=1")
_FINDINGS = ("crash-", "oom-", "timeout-")
"""Prefixes of the files with an input that causes a failure."""


@dataclass(frozen=True)
class Result:
    """The result of fuzzing a parser."""

    name: str
    executions: int
    features: int
    """The fuzzer's coverage features: branches and how often they are taken."""
    findings: Sequence[Path]
    """Files with inputs that cause a failure."""
    status: int
    log: Path

    @property
    def is_bad(self) -> bool:
        return bool(self.findings or self.status or not self.executions)


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
    for old in findings_in(folder):
        old.replace(corpus / old.name)  # try old findings first
    for number, data in enumerate([*under_test.seeds, *kept(name)]):
        (corpus / f"kept-{number}").write_bytes(data)
    words, log = folder / "words.dict", folder / "log.txt"
    lines = ('"' + "".join(f"\\x{byte:02x}" for byte in word) + '"' for word in under_test.words)
    words.write_text("\n".join(dict.fromkeys(lines)) + "\n", encoding="ascii")
    flags = [str(corpus), until, *_FLAGS, f"-artifact_prefix={folder}/", f"-dict={words}"]
    child = [sys.executable, "-m", "tests.fuzz.child", name, *flags]
    environment: Mapping[str, str] = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    if under_test.sanitized:
        with suppress(sanitized_core.NoSanitizersError):
            child, environment = sanitized_core.command("tests.fuzz.random_child", name, *flags)
    with log.open("wb") as file:
        status = subprocess.run(
            child, cwd=ROOT, stdout=file, stderr=file, check=False, env=environment
        ).returncode
    reports = _STATUS.findall(log.read_bytes())
    executions, _, features = map(int, reports[-1]) if reports else (0, 0, 0)
    return Result(name, executions, features, findings_in(folder), status, log)


def findings_in(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.name.startswith(_FINDINGS))


def fuzz_all(names: Sequence[str], minutes: float, jobs: int) -> int:
    """Fuzz ``jobs`` parsers at a time; print the findings; return the number of failed parsers."""
    seconds = max(round(60 * minutes * jobs / len(names)), 1)
    print(f"{len(names)} parsers, {seconds} s each, {jobs} at a time", flush=True)
    bad = 0
    with ThreadPoolExecutor(jobs) as pool:
        for result in pool.map(lambda name: fuzz(name, f"-max_total_time={seconds}"), names):
            bad += result.is_bad
            print(
                f"  {result.name}: {result.executions:,} executions, {result.features:,} features, "
                + (f"status {result.status}, see {result.log}" if result.is_bad else "no finding"),
                flush=True,
            )
            for path in result.findings:
                print(f"    python -m tests.fuzz show {result.name} {path.relative_to(ROOT)}")
    print(f"{bad} of {len(names)} parsers failed")
    return bad
