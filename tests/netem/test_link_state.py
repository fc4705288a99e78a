"""The memory of a link: it outlives a change of settings that is refused."""

import numpy as np
import pytest

from netem import link_state
from netem.link_state import LinkState
from noack.core.core_library import address_of
from noack.impairments.kinds.delay import Delay
from noack.impairments.link_settings import NEVER_NS, LinkSettings


def test_a_refused_change_leaves_a_link_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    link = LinkState(LinkSettings(impairments=(Delay(delay_s=0.001),)), 1, "any")
    link.start_flow(0, 0)
    begin = address_of(link.core.memory), address_of(link.core.stages)

    def refuse(wrong: object) -> None:
        raise ValueError("link: refused")

    monkeypatch.setattr(link_state, "_require", refuse)
    with pytest.raises(ValueError, match="refused"):
        link.change(LinkSettings(), np.full(1, NEVER_NS))
    assert (link._memory["memory"].ctypes.data, address_of(link._stages)) == begin
    assert link.decide(0, 72, 0).release_ns == 1_000_000
