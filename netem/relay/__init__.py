"""The relay around native/relay, which returns to Python for rare events only.

Read ``relay_reports.py``, ``relay_links.py``, ``relay_memory.py``, ``client_table.py`` and
``relay.py``, in this order. A run uses the reports, links and memory only:
``noack/network_process/run_network.py``.
``link_sockets.py`` has the sockets, ``loss_warnings.py`` the warnings.
"""
