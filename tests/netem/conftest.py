"""Fixtures for netem's tests: many compiled decisions and an observer of deliveries."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from netem.engine.compiled_rules import compile_rule, compiled_program, compiled_state, set_flow
from netem.engine.many_decisions import admit_many
from netem.rule_program import empty_state, program_of, recent_width
from noack.impairments.kinds import AnyImpairment
from noack.impairments.link_records import LinkMemory, PacketDecision, RecordedDecision, dtype_of
from noack.impairments.link_settings import LinkSettings

MOST = 1_000_000


class Decided(NamedTuple):
    """The decisions for k datagrams, arrays of shape (k,), and the link's memory."""

    verdicts: NDArray[Any]
    flows: NDArray[np.int64]
    arrivals_ns: NDArray[np.int64]
    state: LinkMemory

    @property
    def fates(self) -> NDArray[np.int64]:
        return np.asarray(self.verdicts["fate"])

    @property
    def delays_ns(self) -> NDArray[np.int64]:
        """Times from arrival to departure in ns, without lost datagrams."""
        return np.asarray((self.verdicts["release_ns"] - self.arrivals_ns)[self.leaves])

    @property
    def leaves(self) -> NDArray[np.bool_]:
        return np.asarray(self.verdicts["release_ns"] >= 0)


Decide = Callable[..., Decided]


@pytest.fixture(scope="session")
def compiled_admit_many() -> Any:
    return compile_rule(admit_many)


@pytest.fixture(scope="session")
def decide(compiled_admit_many: Any) -> Decide:
    """Return decisions of the compiled rules; a scalar argument applies to all datagrams."""

    def run(
        settings: LinkSettings | Sequence[AnyImpairment],
        count: int,
        *,
        seed: int = 0,
        name: Sequence[str] = ("test",),
        flows: ArrayLike = 0,
        sizes_bytes: ArrayLike = 100,
        arrivals_ns: ArrayLike | None = None,
        decisions: Sequence[Sequence[RecordedDecision]] = (),
    ) -> Decided:
        if not isinstance(settings, LinkSettings):
            settings = LinkSettings(impairments=tuple(settings), limit=MOST)
        program = program_of(settings, seed, *name, decisions=decisions)
        all_flows = np.broadcast_to(np.asarray(flows, np.int64), count)
        if arrivals_ns is None:
            arrivals_ns = np.arange(count) * 1_000
        arrivals = np.array(np.broadcast_to(np.asarray(arrivals_ns, np.int64), count))
        sizes = np.array(np.broadcast_to(np.asarray(sizes_bytes, np.int64), count))
        many = int(all_flows.max(initial=0)) + 1
        state = compiled_state(program, empty_state(program), many, recent_width(program))
        for flow in range(many):
            set_flow(state, flow, flow, settings.first_delivered)
        verdicts = np.zeros(count, dtype_of(PacketDecision))
        compiled_admit_many(
            compiled_program(program), state, np.array(all_flows), sizes, arrivals, verdicts
        )
        return Decided(verdicts, np.array(all_flows), arrivals, state)

    return run


def _longest_undelivered(decided: Decided) -> NDArray[np.int64]:
    longest = []
    for flow in range(int(decided.flows.max(initial=0)) + 1):
        verdicts = decided.verdicts[decided.flows == flow]
        numbers = np.arange(len(verdicts))
        assert (verdicts["packet"] == numbers).all()
        first, second = verdicts["release_ns"] >= 0, verdicts["copy_ns"] >= 0
        intact = [first & (verdicts["bit"] < 0), second & (verdicts["copy_bit"] < 0)]
        times = np.concatenate([verdicts["release_ns"][intact[0]], verdicts["copy_ns"][intact[1]]])
        leaving = np.concatenate([numbers[intact[0]], numbers[intact[1]]])
        # Datagrams with equal release times leave in the order of arrival.
        in_order = leaving[np.lexsort((leaving, times))]
        newest = np.maximum.accumulate(np.concatenate([[-1], in_order]))
        counted = in_order[in_order > newest[:-1]]
        gaps = np.diff(np.concatenate([[-1], counted, [len(verdicts)]])) - 1
        longest.append(int(gaps.max()))
    return np.array(longest)


@pytest.fixture(scope="session")
def longest_undelivered() -> Callable[[Decided], NDArray[np.int64]]:
    """Each flow's longest sequence of datagrams that were lost or delivered out of order."""
    return _longest_undelivered


def assert_share(flags: ArrayLike, expected: float, batches: int = 200) -> None:
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
    return assert_share
