"""Locked memory: small mappings are loaded at once, large ones page by page, shared ones kept."""

import subprocess
import sys

import pytest

_PROGRAM = """
import mmap, resource, sys
from pathlib import Path
from noack.runtime.real_time_loop import lock_memory

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

_FORKED = """
import mmap, os, re, sys, threading
from pathlib import Path
from noack.runtime.real_time_loop import lock_memory

def private_bytes():
    text = Path("/proc/self/smaps_rollup").read_text()
    return sum(int(kib) * 1024 for kib in re.findall("Private_Dirty: *([0-9]+) kB", text))

inherited = mmap.mmap(-1, 2**23, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
inherited.write(b"x" * 2**23)
if child := os.fork():
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
end = threading.Event()
threads = [threading.Thread(target=end.wait, daemon=True) for _ in range(8)]
for one in threads:
    one.start()
own = mmap.mmap(-1, 2**21, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
before = private_bytes()
try:
    lock_memory()
except OSError as error:
    sys.exit(f"skip: {error}")
print(private_bytes() - before, flush=True)
os._exit(0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="Linux")
def test_a_forked_process_loads_its_own_memory_and_copies_none() -> None:
    """2 MiB are its own; 8 MiB are its parent's, too, and 64 MiB are the stacks of threads."""
    command = [sys.executable, "-c", _FORKED]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=150)
    if "skip" in done.stderr:
        pytest.skip(done.stderr)
    assert 2**21 <= int(done.stdout) < 2**22


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
