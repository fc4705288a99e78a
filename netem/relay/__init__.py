"""The relay around native/relay, which returns to Python for rare events only.

Read ``relay_links.py``, ``relay_memory.py``, ``client_table.py`` and ``relay.py``, in this order.
"""
