"""Counter-based random numbers: Philox4x32-10 (Salmon, Moraes, Dror & Shaw, SC 2011).

The numbers drawn for a datagram are a function of the stream's key and of the numbers of flow and
datagram. They do not depend on time, on other flows, or on batches; no generator state is needed.
"""

from noack.impairments.link_records import PacketContext, RuleStage

_WORD = 0xFFFFFFFF
_UNIT = 1.0 / 9007199254740992.0
"""2⁻⁵³."""


def philox(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> tuple[int, int, int, int]:
    """Return four random 32-bit words for a counter of four words and a key of two.

    The products may overflow 64 signed bits; the bits that are used are the same in either case.
    """
    for _ in range(10):
        p0 = 0xD2511F53 * c0
        p1 = 0xCD9E8D57 * c2
        c0, c1, c2, c3 = (
            ((p1 >> 32) & _WORD) ^ c1 ^ k0,
            p1 & _WORD,
            ((p0 >> 32) & _WORD) ^ c3 ^ k1,
            p0 & _WORD,
        )
        k0 = (k0 + 0x9E3779B9) & _WORD
        k1 = (k1 + 0xBB67AE85) & _WORD
    return c0, c1, c2, c3


def uniforms(key0: int, key1: int, flow: int, packet: int, block: int) -> tuple[float, float]:
    """Return two uniform numbers in [0, 1), multiples of 2⁻⁵³.

    The stream's key has two words, low and high; flow < 2³², packet < 2⁶³; ``block`` is the number
    of the pair for this datagram.
    """
    a, b, c, d = philox(packet & _WORD, packet >> 32, flow, block, key0, key1)
    return (
        ((a >> 5) * 67108864 + (b >> 6)) * _UNIT,
        ((c >> 5) * 67108864 + (d >> 6)) * _UNIT,
    )


def draw(packet: PacketContext, stage: RuleStage, block: int) -> tuple[float, float]:
    """Return two uniform numbers of a stage for a packet; ``block`` numbers the pairs."""
    return uniforms(stage.key0, stage.key1, packet.flow.number, packet.decision.packet, block)
