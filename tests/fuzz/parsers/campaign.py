"""Campaign files: plain text or, after a zero byte, an edited valid file."""

from unittest.mock import patch

import tomli_w

from cosim.studies.campaign.campaign_file import json_schema, load
from cosim.studies.campaign.campaign_grid import grid
from noack.core.errors import NoackError
from tests.fuzz.choices import EDITS, Choices
from tests.fuzz.edits import Vocabulary, bases, edited, quoted, vocabulary, write_named
from tests.fuzz.harness import FOLDER, refusal, workspace

_SCHEMA = vocabulary(json_schema(), dates=True)
KNOWN = Vocabulary(
    (*_SCHEMA.keys, "network.mansd", "trigger.beta", "trigger", "network.loss", "plant.rate_hz"),
    (*_SCHEMA.words, "lane_following", "decaying", "network.mansd", "beta", "policy"),
    dates=True,
)
SEEDS = [
    *EDITS,
    *(path.read_bytes() for path in sorted((FOLDER.parents[1] / "campaigns").glob("*.toml"))),
]
WORDS = quoted(KNOWN)
BASES = bases("campaigns")
_MOST_POINTS = 8
"""Grid points for which scenarios are made; more points would add no coverage."""


def one_input(data: bytes) -> None:
    if data[:1] == b"\0":
        choices = Choices(data[1:])
        data = tomli_w.dumps(edited(choices, choices.one(BASES), KNOWN)).encode()
    path = write_named(workspace(), "campaign.toml", data)
    with refusal(str(path), lines=True):
        campaign = load(path)
        chosen = list(campaign.selected({}))[:_MOST_POINTS]
        shorter = campaign.model_copy()
        # Skip the computation of each point's guarantee: it is not part of parsing.
        with (
            patch("cosim.studies.campaign.campaign_grid.certified_error", return_value=None),
            patch.object(type(campaign), "selected", lambda *_: iter(chosen)),
        ):
            try:
                grid(shorter, path)
            except NoackError as error:
                # Mistakes in the scenario itself are in another file.
                if not str(error).startswith(str(path)):
                    with refusal(lines=True):
                        raise
                    return
                raise
