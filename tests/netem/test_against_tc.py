"""Compare the parser of netem's words with ``tc``, whose request to the kernel is intercepted."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import settings as example_settings

from netem.core.errors import CallerError
from netem.explanation import tc_command
from netem.impairments.kinds.loss import LossOf
from netem.impairments.link_settings import LinkSettings
from netem.impairments.loss_models.lossless import NoLoss
from netem.tc_words import settings_of
from tests.netem.impairments.any_link_settings import settings as any_settings

_SHIM = """
#include <sys/socket.h>
#include <unistd.h>
ssize_t sendmsg(int fd, const struct msghdr *message, int flags) {
    for (size_t i = 0; i < message->msg_iovlen; i++)
        if (write(1, message->msg_iov[i].iov_base, message->msg_iov[i].iov_len) < 0) _exit(3);
    _exit(0);
}
"""
_HEADERS_BYTES = 36
"""A netlink header of 16 bytes and one of tc; the first has a time stamp."""


class Tc:
    """The program ``tc``; its request to the kernel is intercepted."""

    def __init__(self, folder: Path) -> None:
        source = folder / "shim.c"
        self._shim = folder / "shim.so"
        source.write_text(_SHIM)
        command = ["gcc", "-shared", "-fPIC", "-o", self._shim, source]
        subprocess.run(command, check=True, capture_output=True, timeout=60)

    @staticmethod
    def available() -> bool:
        """Whether ``tc`` and a compiler are installed."""
        return shutil.which("tc") is not None and shutil.which("gcc") is not None

    def request(self, words: str, qdisc: str = "root netem") -> bytes | None:
        """Return the request's attributes for these words; None if tc refuses them."""
        done = subprocess.run(
            ["tc", "qdisc", "add", "dev", "lo", *qdisc.split(), *words.split()],
            env={"LD_PRELOAD": str(self._shim), "PATH": "/usr/sbin:/sbin:/usr/bin:/bin"},
            capture_output=True, check=False, timeout=20,
        )  # fmt: skip
        return done.stdout[_HEADERS_BYTES:] if done.returncode == 0 else None


ETHERNET_BYTES = 42
pytestmark = pytest.mark.skipif(not Tc.available(), reason="needs tc and gcc")


@pytest.fixture(scope="module")
def tc(tmp_path_factory: pytest.TempPathFactory) -> Tc:
    return Tc(tmp_path_factory.mktemp("tc"))


@pytest.mark.parametrize(
    "words",
    [
        "delay 100", "delay 1500us", "delay 10ms", "delay 0.5s", "delay 2sec", "delay 7MSECS",
        "latency 10ms 2ms", "delay 100ms 20ms 25%", "delay 1.5ms 300", "loss 5", "loss 5%",
        "loss 0.3%", "loss 0.3% 25%", "loss random 1e1%", "drop 7% 50",
        "loss state 10%", "loss state 10% 20%", "loss state 10% 20% 3%", "loss state 1 2 3 4",
        "loss state 10% 20% 3% 40% 5%", "loss gemodel 1%", "loss gemodel 1% 10%",
        "loss gemodel 1% 10% 70%", "loss gemodel 1% 10% 70% 0.1%", "duplicate 1%",
        "corrupt 0.1%", "corrupt 0.1% 10%", "delay 10ms reorder 25% 50%",
        "delay 10ms reorder 25% 50% gap 5", "delay 10ms reorder 25%", "rate 1mbit 0",
        "rate 5kbit 20 100 5", "rate 100kbps 0", "rate 1Mibit -14", "rate 80 0", "rate 1.5MBps 4",
        "delay 3usec", "delay 3usecs", "delay 3msec", "delay 2secs", "delay .5ms", "delay 1e1ms",
        "rate 8bit 0", "rate 1kibit 0", "rate 1gibit 0", "rate 1tbit 0", "rate 1bps 0",
        "rate 1KiBps 0", "rate 1gbps 0", "limit 50 delay 1ms",
        "loss 1% delay 10ms 1ms duplicate 2% rate 1gbit 0 limit 77",
    ],
)  # fmt: skip
def test_words_of_tc_have_the_same_meaning_here(tc: Tc, words: str) -> None:
    """The command for the settings makes the same request as the words."""
    limited = words if "limit" in words else f"{words} limit 1000"  # tc's default
    command = tc_command(settings_of(limited)).words
    assert command is not None
    assert tc.request(command) == tc.request(with_overhead(-ETHERNET_BYTES, words)) is not None


@pytest.mark.parametrize(
    ("words", "command"),
    [
        ("rate 10mbit queue 50ms burst 20kb", "rate 10mbit burst 20480 limit 62500"),
        ("rate 1mbit queue 64kb burst 3000", "rate 1mbit burst 3000 limit 64k"),
        ("rate 8kbit queue 1mb burst 8kbit", "rate 8kbit burst 8kbit limit 1mb"),
        ("rate 1mbit 50 queue 20 burst 2kb", "rate 1mbit burst 2k limit 30280 overhead 8"),
        ("rate 1mbit queue 10ms", "rate 1mbit burst 1514 limit 1250"),
    ],
)
def test_a_bottleneck_with_a_burst_is_a_tbf(tc: Tc, words: str, command: str) -> None:
    """Alone, and behind the netem of the other words; sizes have the units of tc."""
    for before in ("", "delay 10ms "):
        nearest = tc_command(settings_of(before + words))
        assert nearest.words == (f"limit 16384 {before.strip()}" if before else None)
        name, _, given = str(nearest.behind).partition(" ")
        assert name == "tbf"
        parent = "parent 1:1 handle 2:" if before else "root"
        assert tc.request(given, f"{parent} tbf") == tc.request(command, f"{parent} tbf") is not None
        assert nearest.commands[-1] == f"tc qdisc add dev DEVICE {parent} tbf {given}"


def with_overhead(more: int, words: str) -> str:
    """Change the overhead of ``rate``: here it is for UDP, in the command for Ethernet."""
    return re.sub(r"rate (\S+) (-?\d+)", lambda at: f"rate {at[1]} {int(at[2]) + more}", words)


@pytest.mark.parametrize(
    "words",
    [
        "loss 101%", "loss x", "loss", "loss gemodle 1%", "loss gemodel x", "delay", "delay 10mm",
        "delay x", "reorder 25%", "delay 1ms gap", "rate 1mb", "rate", "rate 10%", "lsos 5%",
        "duplicate 5%%", "corrupt", "limit", "delay 10ms distribution", "help",
    ],
)  # fmt: skip
def test_words_that_tc_refuses_are_refused_here(tc: Tc, words: str) -> None:
    assert tc.request(words) is None
    with pytest.raises(CallerError):
        settings_of(words)


def test_words_that_only_tc_has_are_refused(tc: Tc) -> None:
    for words in ("slot 800us", "loss 5% ecn"):
        assert tc.request(words) is not None
        with pytest.raises(CallerError, match="this emulator"):
            settings_of(words)


@example_settings(max_examples=40)
@given(settings=any_settings)
def test_each_setting_is_in_the_command_or_named(settings: LinkSettings) -> None:
    command = tc_command(settings)
    wanted = [impairment for impairment in settings.impairments if impairment != LossOf(loss=NoLoss())]
    kinds = ("loss", "delay", "duplicate", "corrupt", "reorder", "rate")
    words = f"{command.words} {command.behind}".split()
    kept = sum(words.count(kind) for kind in kinds)
    own = ("lossrel", "mansd", "first", "atmost", "recover", "ordered")
    left_out = [lack for lack in command.lacks if not lack.startswith(own)]
    assert kept + len(left_out) == len(wanted)
    assert bool(command.commands) != (kept == 0 < len(wanted))


@pytest.mark.parametrize(
    ("words", "remains", "lacks", "notes"),
    [
        ("loss none loss 5% mansd 4", "loss random 5%", "mansd 4 (a cap on consecutive", ""),
        ("loss 5% loss 6%", "loss random 5%", "loss 6% (a second loss)", ""),
        ("loss 5% 10% delay 1ms blackout 1s-2s", "loss random 5% 10% delay 1ms",
         "blackout 1s-2s (blackouts)", "its correlation changes the probability"),
        ("delay 1ms 1ms loss 5%", "delay 1ms 1ms loss random 5%", "", "its order is fixed"),
        ("delay 1ms 1ms distribution pareto", "delay 1ms 1ms distribution pareto", "",
         "its table of the Pareto distribution"),
        ("rate 1mbit reorder 5%", "rate 1mbit -14",
         "reorder 5% (reordering without a delay before it)", "its queue is the limit"),
        (f"loss script {','.join(map(str, range(50)))} delay 1ms", "delay 1ms",
         "loss script 0,1,2,3,4,5,6,7,8,9,10,11,12,13,14,15,16,17,1... (losses", ""),
    ],
)  # fmt: skip
def test_what_tc_lacks_or_does_otherwise_is_named(
    tc: Tc, words: str, remains: str, lacks: str, notes: str
) -> None:
    command = tc_command(settings_of(words))
    assert command.words == f"limit 16384 {remains}"
    assert tc.request(command.words) is not None
    assert len(command.lacks) == bool(lacks)
    assert "".join(command.lacks).startswith(lacks)
    assert notes in " ".join(command.notes)
    assert bool(command.notes) == bool(notes)
