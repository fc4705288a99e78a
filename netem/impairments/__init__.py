"""Impairments of a link: a file per loss model, kind of impairment, discipline and constraint.

Each file holds the settings, the words of the command line, the description and the prediction. A
file of the same name in native/impairments holds the behaviour. The packages import their files
automatically; the JSON schema, the emulator, the words, the explanation and the property tests use
what they import. What stands around them, in the order in which one reads it:

* ``feature.py``: the base classes, and what several features share;
* ``clauses.py``: the words of a feature as data, from which its reading, writing and help follow;
* ``words.py``: words of the command line, and quantities in the syntax of ``tc``;
* ``link_settings.py``: the settings of one direction of a link, made of all these and of the
  guarantee (``netem/guarantee/``);
* ``trace_offset.py``: where in a trace a feature begins;
* ``markov_chain.py``, ``loss_prediction.py``: the expected loss rate, with and without a guarantee;
* ``target_loss.py``: the probability of a loss whose rate is given.

Predictions import scipy in the functions that use it: an emulator without them starts faster.
"""
