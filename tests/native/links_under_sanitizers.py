"""Random links, for a core that is built with sanitizers; test_sanitized.py runs it in a child."""

from collections.abc import Sequence

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from netem.link_state import LinkState
from noack.core.core_library import core, ffi
from noack.impairments.kinds.opportunities import Opportunities
from noack.impairments.link_settings import NEVER_NS, Decisions, LinkSettings, RecordedDecision
from tests.netem.any_settings import capped, computable, harsh

LATEST_NS, LARGEST_BYTES = 2**61, 65_535
"""What the core assumes of packets."""

any_link = st.one_of(computable, harsh, capped)
times_ns = st.integers(0, LATEST_NS)
recorded = st.builds(
    RecordedDecision, st.integers(0, 5), *[st.integers(-1, LATEST_NS)] * 2,
    *[st.integers(-1, 2**63 - 1)] * 2,
)  # fmt: skip
packets = st.lists(
    st.tuples(
        st.integers(0, 4),
        st.one_of(st.sampled_from([0, 1, 72, LARGEST_BYTES]), st.integers(0, LARGEST_BYTES)),
        st.one_of(st.integers(0, 10**7), st.integers(0, LATEST_NS)),
        st.booleans(),
    ),
    max_size=60,
)
"""Row of the flow, size, time since the packet before, and whether it leaves."""


def test_a_queue_that_cannot_be_served_in_time() -> None:
    served = Opportunities(times_ms=(0, 10**12), overhead_bytes=65_535, queue=2)
    link = LinkState(LinkSettings(impairments=(served,), mansd=0), 1, "late")
    link.start_flow(0, 0)
    count = 250_000
    rows, sizes = np.zeros(count, np.int64), np.full(count, LARGEST_BYTES, np.int64)
    decisions = link.decide_many(rows, sizes, np.full(count, LATEST_NS - 10**9))
    assert (decisions["fate"] <= core.NOACK_FORCED).all()


@settings(max_examples=60)
@given(
    st.lists(any_link, min_size=1, max_size=3),
    packets, times_ns, st.lists(st.lists(recorded, max_size=5), max_size=3), st.booleans(),
)  # fmt: skip
def test_random_links(
    settings_in_order: Sequence[LinkSettings],
    arriving: Sequence[tuple[int, int, int, bool]],
    now_ns: int,
    decisions: Decisions,
    restarted: bool,
) -> None:
    link = LinkState(settings_in_order[0], 1, "any", decisions=decisions, restarted=restarted)
    begun: set[int] = set()
    for number, following in enumerate([None, *settings_in_order[1:]]):
        if following is not None:
            latest_ns = np.full(link.rows, now_ns if number % 2 else NEVER_NS, np.int64)
            link.change(following, latest_ns)
        for row, size, step_ns, leaves in arriving:
            if row not in begun:
                link.start_flow(row, row)
                begun.add(row)
            now_ns = min(now_ns + step_ns, LATEST_NS)
            decided = link.decide(row, size, now_ns)
            if leaves and decided.release_ns != NEVER_NS:
                link.leave(
                    row, decided.packet, size, delayed=decided.release_ns > now_ns,
                    counts=decided.bit < 0,
                )  # fmt: skip
    if begun:
        rows = np.array(sorted(begun) * 3, np.int64)
        many = np.full(len(rows), LARGEST_BYTES, np.int64), np.full(len(rows), now_ns, np.int64)
        assert (link.decide_many(rows, *many)["size_bytes"] == LARGEST_BYTES).all()
    keys = ffi.new("int64_t[]", [-1] * (2 * max(link.core.stage_count, 1)))
    core.noack_link_renew(link.core, keys, 1)
    link.decide(0, 72, 0)
