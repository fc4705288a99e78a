"""Fixtures for the tests of impairments: many decisions of the core, and shares with their errors."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from netem.impairments.link_settings import LinkSettings
from netem.link_state import LinkState
from netem.tc_words import settings_of

MOST = 1_000_000


class Decided(NamedTuple):
    """The decisions for k datagrams, arrays of shape (k,), and the link."""

    decisions: NDArray[Any]
    flows: NDArray[np.int64]
    arrivals_ns: NDArray[np.int64]
    link: LinkState

    @property
    def fates(self) -> NDArray[np.int64]:
        return np.asarray(self.decisions["fate"])

    @property
    def delays_ns(self) -> NDArray[np.int64]:
        """Times from arrival to departure in ns, without lost datagrams."""
        times_ns = self.decisions["release_ns"]
        return np.asarray((times_ns - self.arrivals_ns)[times_ns >= 0])


Decide = Callable[..., Decided]


@pytest.fixture(scope="session")
def decide() -> Decide:
    """Return many decisions; a scalar argument applies to all datagrams."""

    def run(
        settings: LinkSettings | str,
        count: int,
        *,
        seed: int = 0,
        flows: ArrayLike = 0,
        sizes_bytes: ArrayLike = 100,
        arrivals_ns: ArrayLike | None = None,
        name: Sequence[str] = ("test",),
    ) -> Decided:
        if isinstance(settings, str):
            settings = settings_of(settings).model_copy(update={"limit": MOST})
        all_flows = np.array(np.broadcast_to(np.asarray(flows, np.int64), count))
        if arrivals_ns is None:
            arrivals_ns = np.arange(count) * 1_000
        arrivals = np.array(np.broadcast_to(np.asarray(arrivals_ns, np.int64), count))
        sizes = np.array(np.broadcast_to(np.asarray(sizes_bytes, np.int64), count))
        link = LinkState(settings, seed, *name)
        for flow in range(int(all_flows.max(initial=0)) + 1):
            link.start_flow(flow, flow)
        return Decided(link.decide_many(all_flows, sizes, arrivals), all_flows, arrivals, link)

    return run


def _assert_share(flags: ArrayLike, expected: float, batches: int = 200) -> None:
    """Check that the mean agrees with ``expected`` to five standard errors of the batch means.

    Flags may be correlated, but the correlation over a whole batch is negligible. The seeds are
    fixed; with random seeds, one test in a million would fail.
    """
    values = np.asarray(flags, float)
    means = values[: len(values) // batches * batches].reshape(batches, -1).mean(axis=1)
    error = means.std(ddof=1) / np.sqrt(batches)
    assert abs(means.mean() - expected) <= 5 * error
    assert error <= 0.1 * expected  # else the assertion above is too weak


@pytest.fixture(scope="session")
def share_is() -> Callable[..., None]:
    return _assert_share
