"""Hypothesis strategies for link settings, derived from the features and their examples."""

from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from hypothesis import strategies as st
from pydantic import ValidationError
from pydantic.fields import FieldInfo

from netem.impairments.constraints import CONSTRAINTS, require_consistent
from netem.impairments.feature import Feature, Impairment
from netem.impairments.kinds import IMPAIRMENTS
from netem.impairments.kinds.corrupt import Corrupt
from netem.impairments.kinds.delay import SHAPES, Delay
from netem.impairments.kinds.reorder import Reorder
from netem.impairments.link_settings import LinkSettings, require_order, require_scores
from tests.netem.impairments.feature_examples import EXAMPLES, IMPAIRED, keeps_loss, names_file

_TEXTS = st.text(st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1).filter(
    lambda name: name not in SHAPES
)


def values(annotation: Any, metadata: list[Any]) -> st.SearchStrategy[Any]:
    """Return values of a field's type within its limits."""
    limits: dict[str, Any] = {}
    for entry in metadata:
        for part in entry.metadata if isinstance(entry, FieldInfo) else [entry]:
            limits |= {name: getattr(part, name) for name in ("ge", "gt", "le", "lt", "min_length")
                       if hasattr(part, name)}  # fmt: skip
    if get_origin(annotation) is Annotated:
        inner, *more = get_args(annotation)
        return values(inner, [*more, *metadata])
    if get_origin(annotation) is Literal:
        return st.sampled_from(get_args(annotation))
    if get_origin(annotation) in (Union, UnionType):
        return st.one_of([values(argument, metadata) for argument in get_args(annotation)])
    if get_origin(annotation) is tuple:
        items = get_args(annotation)
        if items[-1] is ...:
            entries = values(items[0], [])
            return st.lists(entries, min_size=limits.get("min_length", 0), max_size=9).map(tuple)
        return st.tuples(*(values(item, []) for item in items))
    if annotation is float:
        return st.floats(limits.get("ge", limits.get("gt")), limits.get("le", limits.get("lt")),
                         exclude_max="lt" in limits, exclude_min="gt" in limits)  # fmt: skip
    if annotation is int:
        return st.integers(limits.get("ge"), limits.get("le", limits.get("lt", 0) - 1))
    if isinstance(annotation, type) and issubclass(annotation, Feature):
        return varied(annotation)
    plain = {bool: st.booleans(), str: _TEXTS, NoneType: st.none()}
    return plain[annotation]


@st.composite
def varied(draw: st.DrawFn, feature: type[Feature]) -> Any:
    """Return an example of a feature, possibly with other valid values."""
    example = draw(st.sampled_from(EXAMPLES[feature]))
    fields = type(example).model_fields
    names = sorted(draw(st.sets(st.sampled_from(sorted(fields)), max_size=3)))  # as sets have no order
    update = {name: draw(values(fields[name].annotation, fields[name].metadata)) for name in names}
    try:
        return type(example)(**{**dict(example), **update})
    except ValidationError:
        return example


def _goes_together(chain: list[Impairment]) -> bool:
    """Whether each delay with a loss correlation comes after a loss, and so on."""
    try:
        require_scores(chain)
        require_order(chain)
    except ValueError:
        return False
    return True


def _consistent(settings: dict[str, Any]) -> bool:
    try:
        require_consistent(settings["mansd"], settings["constraints"])
    except ValueError:
        return False
    return True


constraints = st.lists(st.one_of([varied(kind) for kind in CONSTRAINTS]), max_size=3).map(tuple)


def _settings(impairments: st.SearchStrategy[Impairment], most: int = 5) -> st.SearchStrategy[LinkSettings]:
    return _chained(st.lists(impairments, max_size=5), most)


def _chained(chains: st.SearchStrategy[list[Impairment]], most: int = 5) -> st.SearchStrategy[LinkSettings]:
    return st.fixed_dictionaries({
        "impairments": chains.filter(_goes_together).map(tuple),
        "mansd": st.none() | st.sampled_from([0, 1, 2, 5]) | st.integers(0, most),
        "constraints": constraints,
        "first_delivered": st.booleans(),
        "limit": st.sampled_from([1, 20, 16_384]),
    }).filter(_consistent).map(lambda given: LinkSettings(**given))  # fmt: skip


def _is_computable(impairment: Impairment) -> bool:
    return not names_file(impairment) and not keeps_loss(impairment)


_ANY = st.one_of([varied(kind) for kind in IMPAIRMENTS])
settings = _settings(_ANY, most=1_000_000)
"""All valid settings, including names of files."""
computable = _settings(_ANY.filter(_is_computable))
_choosing = st.tuples(
    st.none()
    | st.sampled_from([impairment for impairment in IMPAIRED if impairment.kind in ("loss", "blackout")]),
    st.sampled_from([impairment for impairment in IMPAIRED if getattr(impairment, "scheduler", None)]),
    st.none() | st.sampled_from([*EXAMPLES[Corrupt], Delay(delay_s=0.004)]),
).map(lambda chain: [impairment for impairment in chain if impairment and _is_computable(impairment)])
"""Impairments with a queue that chooses what it sends."""
harsh = _settings(
    st.sampled_from([impairment for impairment in IMPAIRED if _is_computable(impairment)])
) | _chained(_choosing)
"""Examples of the features in any order, with short times."""
capped = harsh.filter(lambda settings: settings.impairments and settings.mansd is not None).map(
    lambda settings: settings.model_copy(update={"first_delivered": True})
)


def words_can_say(settings: LinkSettings) -> bool:
    """Whether each reorder comes after a delay; words refuse a reorder without effect."""
    delayed, reordered = False, False
    for impairment in settings.impairments:
        if isinstance(impairment, Reorder) and (reordered or not delayed):
            return False
        delayed = delayed or impairment.delays
        reordered = isinstance(impairment, Reorder)
    return True
