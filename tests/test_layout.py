"""Layout rules of the repository that the import contracts do not cover."""

import ast
import gc
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import grimp
import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from native.build import HEADER

ROOT = Path(__file__).parents[1]
PACKAGES = ("noack", "plant_server", "sensor_node", "controller_node", "netem", "cosim")
EXEMPT = ("__init__", "__main__")
MOST_MODULES = 484
LINES = {
    "noack/scenario": 4250,
    "noack/controllers": 270,
    "noack/core": 1480,
    "noack/disturbances": 220,
    "noack/guarantee": 385,
    "noack/impairments": 4070,
    "noack/machines": 400,
    "noack/observers": 395,
    "noack/plants": 3480,
    "noack/protocol": 1270,
    "noack/runtime": 5830,
    "noack/settings": 605,
    "noack/theory": 13510,
    "noack/traces": 1345,
    "noack/trigger_policies": 1075,
    "netem": 6685,
    "cosim/analysis": 8605,
    "cosim/api": 1695,
    "cosim/cli": 3585,
    "cosim/doctor": 815,
    "cosim/interactive": 1920,
    "cosim/lab": 2010,
    "cosim/live": 4170,
    "cosim/measurement": 3010,
    "cosim/output": 8845,
    "cosim/record": 3745,
    "cosim/simulation": 2010,
    "cosim/studies": 9710,
    "plant_server": 415,
    "sensor_node": 400,
    "controller_node": 415,
    "benchmarks": 3000,
    "native": 11495,
    "tests": 52130,
}
"""Largest number of lines of Python of each folder; of ``native``, of C.

What needs more lines first takes others out, or raises a number here in a commit of its own that
says why.
"""

MARKS = {
    "benchmarks": (28, 5, 0),
    "cosim": (2, 0, 0),
    "cosim/analysis": (7, 3, 0),
    "cosim/cli": (12, 0, 0),
    "cosim/interactive": (2, 2, 0),
    "cosim/lab": (2, 0, 0),
    "cosim/live": (6, 0, 0),
    "cosim/output": (12, 4, 0),
    "cosim/record": (16, 0, 0),
    "cosim/simulation": (0, 4, 0),
    "cosim/studies": (10, 6, 0),
    "netem": (11, 3, 1),
    "noack": (0, 1, 0),
    "noack/core": (2, 0, 0),
    "noack/impairments": (2, 0, 0),
    "noack/observers": (0, 1, 0),
    "noack/plants": (15, 3, 0),
    "noack/protocol": (0, 2, 0),
    "noack/runtime": (6, 1, 0),
    "noack/scenario": (5, 2, 0),
    "noack/settings": (2, 0, 0),
    "noack/theory": (5, 1, 0),
    "noack/traces": (4, 0, 0),
    "noack/trigger_policies": (4, 1, 0),
    "plant_server": (0, 1, 0),
    "sensor_node": (0, 1, 0),
}
"""Largest numbers of lines with ``Any``, of lines with ``# fmt:``, and of imports in functions
without a reason in a comment on their line or the one before, of each folder.

Lower a folder's numbers when it has less.
"""
CIRCLES: set[str] = set()
"""Folders whose modules still import each other in a circle."""
LONG_FUNCTIONS: set[str] = set()
"""Functions that may have more than 60 lines."""
MOST_FILES = 15
FILES = {"noack/trigger_policies": 17}
"""Largest numbers of modules of folders that have more; each trigger policy is a file."""


@dataclass(frozen=True)
class Module:
    """A file of Python outside the tests."""

    path: Path
    text: str
    tree: ast.Module

    @property
    def folder(self) -> str:
        """The folder whose budgets count it."""
        *parents, _ = self.path.relative_to(ROOT).parts
        return "/".join(parents[: 2 if parents[0] in ("noack", "cosim") else 1])

    @property
    def marks(self) -> dict[str, int]:
        """The numbers that MARKS limits, in alphabetical order."""
        lines = ["", *self.text.splitlines()]
        unexplained = {
            node.lineno
            for function in self.functions
            for node in statements(function)
            if isinstance(node, ast.Import | ast.ImportFrom)
            and "#" not in lines[node.lineno] + lines[node.lineno - 1]
        }
        return {
            "Any": sum(bool(re.search(r"\bAny\b", line)) for line in lines),
            "fmt": sum(bool(re.search("# fmt: (skip|off)", line)) for line in lines),
            "imports": len(unexplained),
        }

    @cached_property
    def functions(self) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
        kinds = (ast.FunctionDef, ast.AsyncFunctionDef)
        return [node for node in statements(self.tree) if isinstance(node, kinds)]


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements below a node. Expressions, which have none, are most nodes of a tree."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.stmt | ast.excepthandler | ast.match_case):
            yield child
            yield from statements(child)


@cache
def modules() -> list[Module]:
    paths = (
        path
        for folder in (*PACKAGES, "benchmarks")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if path.name != HEADER
    )
    texts = ((path, path.read_text(encoding="utf-8")) for path in paths)
    gc.disable()  # of a million new objects none is garbage, and the search for some takes 5 s
    parsed = [Module(path, text, ast.parse(text)) for path, text in texts]
    gc.enable()
    return parsed


def test_base_names_of_modules_are_unique() -> None:
    names = Counter(path.stem for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    assert len(names) > 300
    assert [name for name, count in names.items() if count > 1 and name not in EXEMPT] == []


def test_names_of_classes_are_unique() -> None:
    names = Counter(node.name for module in modules() for node in statements(module.tree)
                    if isinstance(node, ast.ClassDef))  # fmt: skip
    assert len(names) > 700
    assert [name for name, count in names.items() if count > 1] == []


def test_no_folder_grows_past_its_budget() -> None:
    folders = {path.parent for package in ("noack", "cosim") for path in ROOT.glob(f"{package}/*/*.py")}
    assert {str(folder.relative_to(ROOT)) for folder in folders} <= LINES.keys()
    larger = {}
    for folder, budget in LINES.items():
        suffixes = (".c", ".h") if folder == "native" else (".py",)
        files = (path for path in (ROOT / folder).rglob("*") if path.suffix in suffixes)
        lines = sum(len(path.read_text().splitlines()) for path in files if path.name != HEADER)
        if lines > budget:
            larger[folder] = f"{lines} lines, at most {budget}"
    assert larger == {}


def test_there_are_not_more_modules() -> None:
    modules = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    assert len([path for path in modules if path.name != HEADER]) <= MOST_MODULES


def test_no_folder_has_more_marks_than_its_budget() -> None:
    marks: dict[str, Counter[str]] = {}
    for module in modules():
        marks.setdefault(module.folder, Counter()).update(module.marks)
    larger = {
        f"{folder}: {kind}": number
        for folder, numbers in marks.items()
        for budget, (kind, number) in zip(MARKS.get(folder, (0, 0, 0)), sorted(numbers.items()), strict=True)
        if number > budget
    }
    assert larger == {}


def test_functions_have_at_most_60_lines() -> None:
    long = {
        function.name
        for module in modules()
        for function in module.functions
        if (function.end_lineno or function.lineno) - function.lineno >= 60
    }
    assert long <= LONG_FUNCTIONS


def test_a_folder_has_few_modules() -> None:
    files = Counter(str(module.path.parent.relative_to(ROOT)) for module in modules()
                    if module.path.stem not in EXEMPT)  # fmt: skip
    assert {folder: n for folder, n in files.items() if n > FILES.get(folder, MOST_FILES)} == {}


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
    circular = {name for name, place in number.items() if (label == label[place]).sum() > 1}
    assert {name.rpartition(".")[0] for name in circular} <= CIRCLES


WALL_CLOCK = {
    "noack/runtime/command_line.py": "lines of the log",
    "noack/plants/systems/code_cache.py": "ages of files",
    "cosim/record/run_directory.py": "the run's name and its environment",
    "cosim/live/coordination/coordinator.py": "when a change was requested",
    "cosim/live/coordination/remote_access.py": "the validity of an invitation",
    "noack/protocol/ros2_node.py": "the time stamps of messages of ROS 2",
    "netem/relay/relay.py": "the times of a capture",
    "netem/control/command_queue.py": "lines of statistics",
    "native/relay/loop.c": "time stamps of the kernel, compared with the monotonic clock",
    "noack/runtime/host_clocks/time_exchange.py": "the same",
}
"""Files that read the wall clock, and for what."""


def test_no_time_of_a_run_is_read_from_the_wall_clock() -> None:
    reads = re.compile(r"\btime\.time(_ns)?\(|CLOCK_REALTIME\)|datetime\.(now|today)\(|utcnow")
    readers = {
        str(path.relative_to(ROOT))
        for folder in (*PACKAGES, "native")
        for path in (ROOT / folder).rglob("*.[pc]*")
        if path.suffix in (".py", ".c") and reads.search(path.read_text())
    }
    assert readers == WALL_CLOCK.keys()
