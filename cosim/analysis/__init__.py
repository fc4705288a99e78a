"""Analysis of scenarios, before a run: certificates, margin, mean cost, adversary; and of runs.

Of a scenario:

* ``certificates.py`` has all certificates, as one object and as a table.
* ``margin_search.py`` finds with how many losses in a row the loop is stable, ``mean_cost.py`` its cost
  under random losses. The mathematics of both is in ``noack/theory``.
* ``adversary`` searches for the loss pattern that comes closest to a certificate's bound.

Of a run, from its record:

* ``summary`` has its numbers, ``claims`` compares them with the certificates.
* ``ideal_loop.py`` compares a run with the ideal loop.
* ``replay`` repeats every step from the recorded inputs, bit for bit.
"""
