"""The rules of a link, one per file, in a subset of Python that compiles unchanged.

Each rule is a function of numbers and of records (slotted dataclasses whose fields are ``int`` or
``float``). The machine of :mod:`netem.link_machine` runs them as they stand; the fast relay
compiles the very same functions with numba, where a record is a row of a structured array. Hence
the style: no objects beyond records, no exceptions, and integers that fit into 64 bits with their
sign.
"""
