"""What a search finds of a loop, and its test in balls before a proof is written. It is not trusted.

``results.py`` has what a search states and assumes, ``exact_test.py`` tests it with the inequalities of the
hybrid system. ``growth.py`` encloses the growth of loops that transmit at least at some times.
"""
