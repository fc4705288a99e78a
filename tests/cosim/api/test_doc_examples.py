"""The examples in the docstrings of the library run, and give what they show."""

import doctest
import importlib

import pytest


@pytest.mark.parametrize("name", ["campaigns", "certificates", "measurements", "runs", "scenarios"])
def test_the_examples_run(name: str) -> None:
    found = doctest.testmod(importlib.import_module(f"cosim.api.{name}"))
    assert found.attempted > 1
    assert found.failed == 0
