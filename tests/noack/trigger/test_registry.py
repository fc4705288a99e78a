"""Properties of every policy file in the policies' folder."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from noack.config.feature_kinds import POLICIES
from noack.config.resolution import policy_of, resolve
from noack.config.scenario_file import validate
from noack.trigger.trigger_policy import Trigger

N = 2
EXAMPLES = {
    name: example for name, made in POLICIES.items() if (example := made.example(N)) is not None
}
MS = 1_000_000


def samples(seed: int, k: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Times every 10 ms, and z = (x, e_s) on smooth curves with a growing error."""
    rng = np.random.default_rng(seed)
    t_ns = 10 * MS * np.arange(1, k + 1)
    phase, rate = rng.uniform(0, 6, 2 * N), rng.uniform(0.2, 3, 2 * N)
    z = np.sin(phase + np.outer(t_ns * 1e-9, rate))
    z[:, N:] *= (t_ns * 1e-9)[:, None] * rng.choice([0.01, 0.1, 1.0])
    return t_ns, z


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", EXAMPLES)
def test_a_block_of_measurements_gives_the_same_event_as_single_ones(
    content: dict[str, Any], name: str, seed: int
) -> None:
    table = EXAMPLES[name].model_dump(mode="json", exclude_none=True)
    policy = policy_of(resolve(validate(content | {"trigger": table}, "here")))
    at_once, one_by_one = Trigger(policy), Trigger(policy)
    t_ns, z = samples(seed, 400)
    start = np.array([0.5, -0.3])
    for trigger in (at_once, one_by_one):
        trigger.start(0, start)
    decisions = (one_by_one.test(int(t), x[:N], x[N:]) for t, x in zip(t_ns, z, strict=True))
    expected = next((k for k, decision in enumerate(decisions) if decision.event), None)
    found = None
    # in blocks: accumulated quantities continue from block to block
    for begin in range(0, len(z), 32):
        block = slice(begin, begin + 32)
        k = at_once.first_event(t_ns[block], z[block, :N], z[block, N:])
        if k is not None:
            found = begin + k
            break
    assert found == expected
