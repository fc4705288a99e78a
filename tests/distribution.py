"""Who runs which tests when there are several workers: ``--dist=loadfile``, longest files first.

A worker that gets a long file last keeps the others waiting for it. And a file whose tests share
nothing, but start a run each, is no unit: any worker may take any of them.
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
    "tests/integration/test_faults_paused.py",
    "tests/integration/test_terminals.py",
    "tests/integration/",
    "tests/noack/theory/test_box.py",
    "tests/noack/theory/test_certificate.py",
    "tests/cosim/studies/campaign/",
    "tests/cosim/studies/design/",
    "tests/cosim/output/viewer/",
    "tests/netem/",
)
"""Files and folders, by what they take."""

APART = frozenset({
    "tests/integration/test_faults.py",
    "tests/integration/test_faults_by_hand.py",
    "tests/integration/test_faults_disk.py",
    "tests/integration/test_faults_paused.py",
    "tests/integration/test_simulation.py",
    "tests/integration/test_terminals.py",
    "tests/test_examples.py",
})  # fmt: skip
"""Files whose tests share no fixture that takes long."""


def in_order(items: Iterable[pytest.Item]) -> list[pytest.Item]:
    """The tests, those of long files first."""
    ranks = {file: rank for rank, file in enumerate(LONGEST)}

    def rank(item: pytest.Item) -> int:
        file = file_of(item.nodeid)
        named = (ranks[part] for part in ranks if file.startswith(part))
        return min(named, default=len(ranks))

    return sorted(items, key=rank)


def file_of(nodeid: str) -> str:
    return nodeid.partition("::")[0]


class LongestFirst(LoadFileScheduling):
    """Gives out files, or the tests of some, in the order of collection."""

    def __init__(self, config: pytest.Config, log: Any) -> None:
        config.option.loadscopereorder = False
        super().__init__(config, log)

    def _split_scope(self, nodeid: str) -> str:
        file = file_of(nodeid)
        return nodeid if file in APART else file
