"""The progress of work that has parts."""

import pytest

from noack.core.progress import part_of


def test_the_parts_of_some_work_follow_each_other_to_its_end() -> None:
    shares: list[float] = []
    for begin, end in ((0.0, 0.25), (0.25, 0.5), (0.5, 1.0)):
        part = part_of(lambda done, total=1.0, /: shares.append(done / total), begin, end)
        part(0.0)
        part_of(part, 0.0, 0.5)(1.0)  # a part of the part
        part(9.0, 10.0)
        part(1.0)
    assert shares == pytest.approx([0, 0.125, 0.225, 0.25, 0.25, 0.375, 0.475, 0.5, 0.5, 0.75, 0.95, 1.0])
