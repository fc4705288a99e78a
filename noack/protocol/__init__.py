"""Data that the processes exchange: wire format, roles, record tables.

``roles.py`` says who sends what to whom, ``wire_format.py`` has the datagrams, ``record_tables.py``
the rows that are recorded of them.
"""
