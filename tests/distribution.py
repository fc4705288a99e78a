"""Distribute tests over several workers: ``--dist=loadfile``, longest files first.

If a worker starts a long file last, all other workers wait for it. If the tests of a file share no
slow fixture, the scheduler distributes them one by one.
"""

from collections.abc import Iterable
from typing import Any

import pytest
from xdist.scheduler import LoadFileScheduling

LONGEST = (
    "tests/test_docs.py",
    "tests/integration/test_faults.py",
    "tests/integration/test_restarts.py",
    "tests/integration/test_run.py",
    "tests/cosim/studies/campaign/test_workers.py",
    "tests/attacks/test_attacks.py",
    "tests/integration/test_faults_disk.py",
    "tests/integration/test_disturbed_run.py",
    "tests/integration/test_terminals.py",
    "tests/integration/",
    "tests/noack/theory/test_box.py",
    "tests/noack/theory/test_certificate.py",
    "tests/cosim/studies/campaign/",
    "tests/cosim/studies/design/",
    "tests/cosim/output/viewer/",
    "tests/netem/",
)
"""Files and folders, longest duration first."""

APART = frozenset({
    "tests/integration/test_faults.py",
    "tests/integration/test_faults_by_hand.py",
    "tests/integration/test_faults_disk.py",
    "tests/integration/test_simulation.py",
    "tests/integration/test_terminals.py",
    "tests/test_examples.py",
})  # fmt: skip
"""Files in which the tests share no slow fixture."""


def in_order(items: Iterable[pytest.Item]) -> list[pytest.Item]:
    """Return the tests, those of long files first."""
    ranks = {file: rank for rank, file in enumerate(LONGEST)}

    def rank(item: pytest.Item) -> int:
        file = file_of(item.nodeid)
        named = (ranks[part] for part in ranks if file.startswith(part))
        return min(named, default=len(ranks))

    return sorted(items, key=rank)


def file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]


class LongestFirst(LoadFileScheduling):
    """Assigns files, or single tests of the files in ``APART``, in the order of collection."""

    def __init__(self, config: pytest.Config, log: Any) -> None:
        config.option.loadscopereorder = False
        super().__init__(config, log)

    def _split_scope(self, nodeid: str) -> str:
        file = file_of(nodeid)
        return nodeid if file in APART else file
