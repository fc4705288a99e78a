"""The examples in the docstrings of the library run, and give what they show."""

import doctest

import pytest

import noack

EXAMPLES = [name for name in noack.__all__ if ">>>" in (getattr(noack, name).__doc__ or "")]


def test_every_function_that_begins_something_has_an_example() -> None:
    assert {"load", "simulate", "certify", "margin", "campaign", "measure", "explore"} <= {
        *EXAMPLES
    }


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_examples_run(name: str) -> None:
    finder = doctest.DocTestFinder(recurse=False)
    (example,) = finder.find(getattr(noack, name), name, module=False, globs={})
    found = doctest.DocTestRunner().run(example)
    assert found.attempted > 1
    assert found.failed == 0
