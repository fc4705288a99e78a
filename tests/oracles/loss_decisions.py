"""The fates of a flow's packets on a link that loses and does not delay, by definition.

Independent of the core: Philox4x32-10 (Salmon et al. 2011), the losses, and the guarantee, which
holds as long as :mod:`tests.oracles.loss_language` allows the outcomes. Only the key of the random
stream comes from noack: numpy's SeedSequence.
"""

from collections.abc import Callable

from noack.core.random_streams import stream_key
from noack.impairments.kinds.loss import LossOf
from noack.impairments.link_settings import LinkSettings
from noack.impairments.loss_models.bernoulli import BernoulliLoss
from noack.impairments.loss_models.gilbert_elliott import GilbertElliottLoss
from noack.protocol.record_tables import Fate
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


def uniform_pair(key: tuple[int, int], flow: int, packet: int) -> tuple[float, float]:
    """The first two numbers in [0, 1) of a packet, of 53 bits each."""
    words = philox((packet & _MASK, packet >> 32, flow, 0), key)
    first, second = ((words[i] >> 5) << 26 | words[i + 1] >> 6 for i in (0, 2))
    return first / 2**53, second / 2**53


def fates_of_flow(settings: LinkSettings, seed: int, name: str, flow: int, count: int) -> list[Fate]:
    """Return the fates of the first packets of a flow; the link's one impairment is a loss."""
    (impairment,) = settings.impairments
    assert isinstance(impairment, LossOf)
    key = stream_key(seed, "netem", name, "loss")
    is_lost = _losses(impairment.loss)
    outcomes: list[bool] = []
    fates = []
    for packet in range(count):
        lost = is_lost(*uniform_pair(key, flow, packet))
        may_be_lost = is_allowed([*outcomes, True], settings) and (packet or not settings.first_delivered)
        outcomes.append(lost and bool(may_be_lost))
        fate_of_loss = Fate.DROPPED if may_be_lost else Fate.FORCED
        fates.append(fate_of_loss if lost else Fate.DELIVERED)
    return fates


def _losses(loss: object) -> Callable[[float, float], bool]:
    """Return a function of the two numbers of each packet in turn: whether the link loses it."""
    if isinstance(loss, BernoulliLoss):
        return lambda first, _: first < loss.probability
    assert isinstance(loss, GilbertElliottLoss)
    assert loss.good_to_bad is not None
    assert loss.bad_to_good is not None
    changes, lost_in = (loss.good_to_bad, loss.bad_to_good), (loss.loss_in_good, loss.loss_in_bad)
    state = 0

    def is_lost(first: float, second: float) -> bool:
        nonlocal state
        state ^= first < changes[state]
        return second < lost_in[state]

    return is_lost
