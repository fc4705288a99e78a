"""Settings of every impairment and constraint, mainly extreme ones; together they use every key."""

import json
from collections import defaultdict
from typing import Any

from netem.impairments.constraints import CONSTRAINTS
from netem.impairments.feature import Constraint, Feature, Impairment
from netem.impairments.kinds import IMPAIRMENTS
from netem.impairments.words import WordReader

CHANCES = ("0%", "10%", "50% 70%", "90%", "100%")
WORDS = f"""
    loss none
    loss worst
    {"; ".join(f"loss {chance}" for chance in CHANCES)}; loss 10% keep
    loss state 30% 40% 20% 70% 10%; loss state 10% 30%
    loss gemodel 10% 50%; loss gemodel 50% 10% 90% 10%; loss gemodel 100% 0%
    loss gemodel 0% 0% 100% 10%; loss gemodel 50% 10% 90% 10% common 2ms
    loss burst 40% 3; loss burst 40% 3 common 2ms
    loss periodic 1/3; loss periodic 3/9 from 5; loss periodic 0/4; loss periodic 2/2 from 7
    loss script 0,1,2,5,8,9; loss script 0,1,5 every 11; loss script none
    loss trace trace.txt; loss trace 'a trace.txt' once
    delay 500us; delay 4ms 4ms; delay 4ms 4ms distribution normal
    delay 4ms 4ms distribution pareto; delay 4ms 4ms distribution paretonormal
    delay 0s 500us 70%; delay 10ms 10ms distribution normal lossrel 80%
    delay 0s samples 0s,1ms,2ms,9ms; delay 4ms 4ms ordered; delay 1ms 9ms 50% distribution normal ordered
    {"; ".join(f"{kind} {chance}" for kind in ("corrupt", "duplicate") for chance in CHANCES)}
    reorder 0%; reorder 50%; reorder 90% gap 2; reorder 100% gap 4; reorder 50% 70% gap 3
    blackout 0s-10ms,20ms-30ms every 50ms; blackout 1ms-20ms; outages 'my outages.txt' every 60s
    rate 5mbit queue 1; rate 5mbit queue 1 codel; rate 5mbit queue 50; rate 5mbit queue 50 codel
    rate 5mbit queue 50 codel target 10us interval 100us mtu 0
    rate 5mbit queue 3 priority 2,1; rate 5mbit queue 50 priority 1,0,1
    rate 5mbit queue 3 maximum_error; rate 5mbit queue 50 maximum_error
    rate 5mbit queue 3 earliest_deadline 1ms,0s; rate 5mbit queue 50 48 48 5 earliest_deadline 0s,300us,100us
    rate 5mbit queue 3ms; rate 5mbit queue 9kb burst 4kb; rate 5mbit queue 5 burst 1500b codel
    rate 5mbit queue 4kb priority 1,0; rate 100mbit -20 queue 200us burst 200b
    rate 100mbit queue 5; rate 100mbit queue 5 codel; rate 1gbit -10 48 5
    rate 100mbit queue 5 codel target 10us interval 100us mtu 0
    opportunities at 0,0,1,2,2,2,5 queue 2
    opportunities at 0,0,1,2,2,2,5 queue 50 bytes 4000 from random
    opportunities at 1 queue 1 overhead -10 from 500us; opportunities at 0,20 queue 5
    opportunities 'a trace.up'
    schedule 0 slot 2ms; schedule 1,0,-1,0,0 slot 1ms queue 1; schedule -1,0 slot 300us queue 3
    {
    "; ".join(
        f"replay records 0s+3ms,1ms+lost,1ms+9ms,4ms+2ms,5ms+lost,5.000001ms+0s{options}"
        for options in ("", " by time share 30% from random", " once from 2ms", " by time once")
    )
}
    replay records 0s+lost; replay 'a trace.csv' relative
    atmost 0 in 1; atmost 1 in 2; atmost 1 in 3; atmost 2 in 5; atmost 3 in 10; atmost 5 in 7
    recover 1; recover 2; recover 3; recover 7
"""
_CLAUSES = {clause.word: (kind, clause) for kind in (*IMPAIRMENTS, *CONSTRAINTS) for clause in kind.clauses}


def _read(words: str) -> Any:
    reader = WordReader(words)
    kind, clause = _CLAUSES[str(reader.begin())]
    table = {"kind": kind.model_fields["kind"].default, **clause.read(reader)}
    return kind.model_validate_json(json.dumps(table))


_ALL = [_read(words) for line in WORDS.splitlines() for words in line.split(";") if words.strip()]
IMPAIRED = [feature for feature in _ALL if isinstance(feature, Impairment)]
CONSTRAINED = [feature for feature in _ALL if isinstance(feature, Constraint)]
EXAMPLES: dict[type[Feature], list[Feature]] = defaultdict(list)
"""By their classes, also of loss models and disciplines."""
for _one in _ALL:
    for _feature in (_one, getattr(_one, "loss", None), getattr(_one, "discipline", None)):
        if _feature is not None:
            EXAMPLES[type(_feature)].append(_feature)


def names_file(feature: Feature) -> bool:
    """Whether it names a file that has not been read."""
    return getattr(getattr(feature, "loss", feature), "file", None) is not None


def keeps_loss(feature: Feature) -> bool:
    """Whether it keeps a loss rate, which the others may make impossible."""
    return bool(getattr(getattr(feature, "loss", None), "keep", False))
