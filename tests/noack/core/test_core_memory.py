"""Arrays of the core's structures: copies that live as long as their memory."""

import gc

import numpy as np

from noack.core.core_library import CoreMemory, core, ffi, reals_at


def test_arrays_are_copies_that_live_with_their_memory() -> None:
    memory, given = CoreMemory(), np.arange(6.0).reshape(2, 3).T
    pointer, whole = memory.reals(given), memory.integers([3, -1])
    shown = reals_at(pointer, 3, 2)
    given[:] = 0
    gc.collect()
    assert shown.tolist() == [[0.0, 3.0], [1.0, 4.0], [2.0, 5.0]]
    assert (whole[0], whole[1]) == (3, -1)
    shown[0, 1] = 7.0  # shares the memory
    assert pointer[1] == 7.0
    assert reals_at(memory.zeros(0), 0).tolist() == []


def test_models_with_the_same_matrix_share_its_exponentials() -> None:
    memory, H = CoreMemory(), np.array([[0.0, 1.0], [-2.0, -0.5]])
    one, other = memory.transitions(H, (5, 0)), memory.transitions(H.copy(), (7,))
    assert one is other
    assert memory.transitions(-H) is not one
    known = np.frombuffer(ffi.buffer(one.steps_ns, 8 * one.places), np.int64)
    assert sorted(known[known != 0]) == [5, 7]
    matrix = core.noack_transition(one, 5)
    assert matrix - one.matrices in range(0, 4 * one.places, 4)  # kept, where it was
    assert sorted(known[known != 0]) == [5, 7]
