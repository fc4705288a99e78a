"""Layout rules of the repository that the import contracts do not cover."""

import ast
import re
from collections import Counter
from pathlib import Path

import grimp
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from native.build import HEADER

ROOT = Path(__file__).parents[1]
PACKAGES = ("noack", "plant_server", "sensor_node", "controller_node", "netem", "cosim")
EXTENSIONS = sorted(str(path.relative_to(ROOT)) for path in ROOT.glob("extensions/*/noack_*"))


def test_names_of_classes_are_unique() -> None:
    names = Counter(
        node.name
        for folder in (*PACKAGES, "benchmarks", *EXTENSIONS)
        for path in (ROOT / folder).rglob("*.py")
        if path.name != HEADER
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef)
    )
    assert len(names) > 100
    assert [name for name, count in names.items() if count > 1] == []


def test_no_modules_import_each_other_in_a_circle() -> None:
    """Imports in functions count, those for type checkers alone do not."""
    graph = grimp.build_graph(*PACKAGES, exclude_type_checking_imports=True, cache_dir=None)
    number = {name: place for place, name in enumerate(sorted(graph.modules))}
    pairs = [
        (number[name], number[other])
        for name in number
        for other in graph.find_modules_directly_imported_by(name)
    ]
    matrix = csr_array((np.ones(len(pairs)), tuple(np.transpose(pairs))), shape=(len(number),) * 2)
    _, label = connected_components(matrix, connection="strong")
    assert {name for name, place in number.items() if (label == label[place]).sum() > 1} == set()


def test_an_extension_imports_public_names_alone() -> None:
    imports = {
        (path.name, module)
        for folder in EXTENSIONS
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        for module in ([node.module or ""] if isinstance(node, ast.ImportFrom) else
                       [alias.name for alias in node.names] if isinstance(node, ast.Import) else [])
    }  # fmt: skip
    ours = {(name, module) for name, module in imports if module.split(".")[0] in PACKAGES}
    assert len(ours) > 2
    assert [(name, module) for name, module in ours if module not in ("noack", "noack.extend")] == []


WALL_CLOCK = {
    "netem/core/command_line.py": "lines of the log",
    "cosim/record/run_directory.py": "the run's name and its environment",
    "cosim/live/coordination/change_requests.py": "when a change was requested",
    "cosim/live/coordination/certificate_authority.py": "the validity of a run's certificates",
    "extensions/noack-ros2/noack_ros2/ros2_node.py": "the time stamps of messages of ROS 2",
    "netem/control/command_queue.py": "lines of statistics",
    "native/relay/loop.c": "time stamps of the kernel, compared with the monotonic clock",
    "noack/runtime/host_clocks.py": "the epoch of a run on several hosts",
}
"""Files that read the wall clock, and for what."""


def test_no_time_of_a_run_is_read_from_the_wall_clock() -> None:
    reads = re.compile(r"\btime\.time(_ns)?\(|CLOCK_REALTIME\)|datetime\.(now|today)\(|utcnow")
    readers = {
        str(path.relative_to(ROOT))
        for folder in (*PACKAGES, "checker", "native", *EXTENSIONS)
        for path in (ROOT / folder).rglob("*.[pc]*")
        if path.suffix in (".py", ".c") and reads.search(path.read_text())
    }
    assert readers == WALL_CLOCK.keys()


def test_no_test_imports_another_one() -> None:
    """What several tests need has a module of its own."""
    imports = re.compile(r"^(from|import) tests\.(\w+\.)*test_", re.MULTILINE)
    assert [str(path) for path in (ROOT / "tests").rglob("*.py") if imports.search(path.read_text())] == []
