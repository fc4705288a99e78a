"""Layout rules of the repository that the import contracts do not cover."""

from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("noack", "plant_server", "sensor_node", "controller_node", "netem", "cosim")
EXEMPT = ("__init__", "__main__")


def test_base_names_of_modules_are_unique() -> None:
    names = Counter(path.stem for package in PACKAGES for path in (ROOT / package).rglob("*.py"))
    assert len(names) > 300
    assert [name for name, count in names.items() if count > 1 and name not in EXEMPT] == []
