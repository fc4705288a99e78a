"""Locked memory: small mappings are loaded at once, large ones page by page."""

import subprocess
import sys

import pytest

_PROGRAM = """
import mmap, resource, sys
from pathlib import Path
from noack.runtime.memory_lock import lock_memory

def resident_bytes():
    return int(Path("/proc/self/statm").read_text().split()[1]) * mmap.PAGESIZE

def faults_of_writing(block):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for place in range(0, len(block), mmap.PAGESIZE):
        block[place] = 1
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

large, small = mmap.mmap(-1, 2**29), mmap.mmap(-1, 2**22)
before = resident_bytes()
try:
    lock_memory()
except OSError as error:
    sys.exit(f"skip: {error}")
grown = resident_bytes() - before
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(grown, faults_of_writing(small), int(status["VmLck"].split()[0]) * 1024)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux")
def test_all_memory_is_locked_but_large_mappings_are_not_loaded() -> None:
    command = [sys.executable, "-c", _PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=150)
    if done.stderr.startswith("skip"):
        pytest.skip(done.stderr)
    grown_bytes, faults, locked_bytes = map(int, done.stdout.split())
    assert grown_bytes < 2**27
    assert faults < 100  # of 1024 pages
    assert locked_bytes > 2**29
