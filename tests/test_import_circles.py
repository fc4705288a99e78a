"""No module imports itself through others; graphlib names the circle if one does."""

import ast
import graphlib
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("noack", "netem", "cosim", "plant_server", "sensor_node", "controller_node")


def imported(body: list[ast.stmt]) -> Iterator[str]:
    """The names that a module imports when it is imported, and not for type checking only."""
    for one in body:
        match one:
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                yield from imported(one.orelse)
            case ast.Import():
                yield from (name.name for name in one.names)
            case ast.ImportFrom(module=str(module)):
                yield from (f"{module}.{name.name}" for name in one.names)
                yield module
            case ast.If() | ast.Try() | ast.With():
                yield from imported([*one.body, *getattr(one, "orelse", [])])


def test_there_is_no_import_circle() -> None:
    files = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    names = {path.relative_to(ROOT).with_suffix("").parts: path for path in files}
    modules = {".".join(name): path for name, path in names.items() if name[-1] != "__init__"}
    graph = {
        name: {other for other in imported(ast.parse(path.read_text()).body) if other in modules}
        for name, path in modules.items()
    }
    graphlib.TopologicalSorter(graph).prepare()
