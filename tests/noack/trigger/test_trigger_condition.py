import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from noack.trigger.trigger_condition import (
    QuadraticForm,
    TriggerCondition,
    empty_map,
    error_form,
    error_map,
)

_VECTORS = st.integers(1, 9).flatmap(lambda n: arrays(float, (2, n), elements=st.floats()))


@given(_VECTORS, st.sampled_from([0.0, 0.3]))
def test_the_error_itself_has_the_bits_of_its_quadratic_form(
    vectors: np.ndarray, auxiliary: float
) -> None:
    """Also if a run diverges: e_s = x_s − x of any x_s and x."""
    x_s, x = vectors
    n = len(x)
    with np.errstate(all="ignore"):
        e_s = x_s - x
        short, long = (
            TriggerCondition(form, floor=0.1).sides(0, x, e_s, auxiliary)
            for form in (error_form(n), QuadraticForm(error_map(n), empty_map(n)))
        )
    np.testing.assert_array_equal(short, long)
