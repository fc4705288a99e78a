"""The pytest plug-in: the fixture ``lossy_udp``, an emulator between two sockets of a test.

pytest loads this file with each start, so that it imports the emulator only for a test that uses
the fixture.
"""

from __future__ import annotations

import os
import secrets
import shlex
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from netem.lossy_udp import LossyUdp

SEED = "NOACK_SEED"
_OPTION = "--noack-seed"
_LINKS = pytest.StashKey[list["LossyUdp"]]()
_COMMON = pytest.StashKey[int]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option, and the key of the configuration file."""
    text = f"seed of the fixture lossy_udp; by default ${SEED}, or a random one"
    parser.getgroup("noack").addoption(_OPTION, metavar="SEED", help=text)
    parser.addini("noack_seed", text)


def pytest_configure(config: pytest.Config) -> None:
    """Choose the seed of all tests of this process: a given one, or a random one."""
    seed_texts = {
        _OPTION: config.getoption(_OPTION),
        SEED: os.environ.get(SEED),
        "noack_seed": config.getini("noack_seed"),
    }
    for name, text in seed_texts.items():
        if text and not (text.isdecimal() and int(text) < 2**64):
            raise pytest.UsageError(f"{name} {text}: must be 0 or more, below 2^64")
    seeds = [int(text) for text in seed_texts.values() if text]
    config.stash[_COMMON] = seeds[0] if seeds else secrets.randbits(32)


@pytest.fixture
def lossy_udp(request: pytest.FixtureRequest) -> Iterator[Callable[..., LossyUdp]]:
    """A function that starts an emulator: ``lossy_udp(server, "loss 30% mansd 4")``.

    It has the arguments of :class:`netem.lossy_udp.LossyUdp`. Clients send to the ``address`` of
    what it returns. All end with the test; a test that fails reports their seed and their losses.
    """
    from netem.lossy_udp import LossyUdp

    common = request.config.stash[_COMMON]
    links: list[LossyUdp] = request.node.stash.setdefault(_LINKS, [])
    with ExitStack() as stack:

        def start(
            to: str | Sequence[str | int],
            words: str = "",
            *,
            reverse: str | None = None,
            seed: int | None = None,
            listen: str | Sequence[str | int] = "127.0.0.1:0",
            timetable: str | os.PathLike[str] | None = None,
            repeat_s: float | None = None,
        ) -> LossyUdp:
            # Each link has a seed of its own, so that links with the same words differ.
            link_seed = (common + len(links)) % 2**64 if seed is None else seed
            name = f"link {len(links) + 1}"
            link = LossyUdp(
                to, words, reverse=reverse, seed=link_seed, listen=listen, name=name,
                timetable=timetable, repeat_s=repeat_s,
            )  # fmt: skip
            links.append(stack.enter_context(link))
            return link

        yield start


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Report which network a failed test had, and how to have it again."""
    report = yield
    if report.failed and (links := item.stash.get(_LINKS, [])):
        file, colons, name = item.nodeid.partition("::")  # of the root folder, which may be another
        test = os.path.relpath(item.config.rootpath / file, item.config.invocation_params.dir) + colons + name
        command = f"the same losses again: pytest {_OPTION} {item.config.stash[_COMMON]} {shlex.quote(test)}"
        text = "\n".join([*map(str, links), command])
        add = getattr(report.longrepr, "addsection", None)  # shown whatever --show-capture is
        if add is not None:
            add("lossy_udp", text)
        else:
            report.sections.append(("lossy_udp", text))
    return report
