"""The fates of a flow's packets on a link that loses and duplicates, and does not delay, by definition.

Independent of the core: Philox4x32-10 (Salmon et al. 2011), the losses, and the guarantee, which
holds as long as :mod:`tests.oracles.loss_language` allows the outcomes. Only the key of the random
stream comes from noack: numpy's SeedSequence.
"""

from collections import Counter
from typing import Protocol

from netem.core.packet_rows import Fate
from netem.core.random_streams import stream_key
from netem.impairments.kinds.duplicate import Duplicate
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.bernoulli import BernoulliLoss
from netem.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from tests.oracles.loss_language import is_allowed

_MASK = 2**32 - 1
_FACTORS, _KEY_STEPS = (0xD2511F53, 0xCD9E8D57), (0x9E3779B9, 0xBB67AE85)


def philox(counter: tuple[int, ...], key: tuple[int, ...]) -> tuple[int, ...]:
    """Philox4x32 with ten rounds: four words of 32 bits from a counter of four and a key of two."""
    for number in range(10):
        first, second = (factor * word for factor, word in zip(_FACTORS, counter[::2], strict=True))
        own = [(word + number * step) & _MASK for word, step in zip(key, _KEY_STEPS, strict=True)]
        counter = (
            second >> 32 ^ counter[1] ^ own[0], second & _MASK,
            first >> 32 ^ counter[3] ^ own[1], first & _MASK,
        )  # fmt: skip
    return counter


def uniform_pair(key: tuple[int, int], flow: int, packet: int, copy: int) -> tuple[float, float]:
    """The first two numbers in [0, 1) of a packet, or of its second copy, of 53 bits each."""
    words = philox((packet & _MASK, packet >> 32, flow, 2 * copy), key)
    first, second = ((words[i] >> 5) << 26 | words[i + 1] >> 6 for i in (0, 2))
    return first / 2**53, second / 2**53


def fates_of_flow(settings: LinkSettings, seed: int, name: str, flow: int, count: int) -> list[Fate]:
    """Return the fates of the first packets of a flow on a link of losses and duplicates.

    Each of at most two copies of a packet passes the impairments behind its duplication by itself.
    """
    numbers: Counter[str] = Counter()
    stages = []
    for impairment in settings.impairments:
        numbers[impairment.kind] += 1
        number = numbers[impairment.kind]
        stream = impairment.kind if number == 1 else f"{impairment.kind} {number}"
        stages.append((stream_key(seed, "netem", name, stream), _random_event(impairment)))
    outcomes: list[bool] = []
    fates = []
    for packet in range(count):
        copies = [True, False]
        for (key, event), impairment in zip(stages, settings.impairments, strict=True):
            before = list(copies)
            happens = event(*uniform_pair(key, flow, packet, 0), advances=True)
            if isinstance(impairment, Duplicate):
                copies = [happens or copies[0], happens or copies[1]] if any(copies) else copies
                continue
            copies[0] &= not happens
            if before[1]:
                copies[1] = not event(*uniform_pair(key, flow, packet, 1), advances=False)
        lost = not any(copies)
        may_be_lost = is_allowed([*outcomes, True], settings) and (packet or not settings.first_delivered)
        outcomes.append(lost and bool(may_be_lost))
        fate_of_loss = Fate.DROPPED if may_be_lost else Fate.FORCED
        fates.append(fate_of_loss if lost else Fate.DELIVERED)
    return fates


class _Event(Protocol):
    """Whether something happens to a packet, given its two numbers; ``advances``: to the original."""

    def __call__(self, first: float, second: float, *, advances: bool) -> bool: ...


def _random_event(impairment: object) -> _Event:
    """Return a function for the copies of each packet in turn: whether it is lost, or duplicated."""
    event = impairment.loss if isinstance(impairment, LossOf) else impairment
    if isinstance(event, BernoulliLoss | Duplicate):
        probability = event.probability
        return lambda first, second, advances: first < probability
    assert isinstance(event, GilbertElliottLoss)
    assert event.good_to_bad is not None
    assert event.bad_to_good is not None
    changes, lost_in = (event.good_to_bad, event.bad_to_good), (event.loss_in_good, event.loss_in_bad)
    state = 0

    def is_lost(first: float, second: float, *, advances: bool) -> bool:
        nonlocal state
        following = state ^ (first < changes[state])
        if advances:
            state = following
        return second < lost_in[following]

    return is_lost
