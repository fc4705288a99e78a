"""Output for people: figures, tables, pages, the terminal, the viewer, and exports.

A figure is described once and drawn by one renderer per medium (``figures``). Tables are
rows of text (``result_tables``, ``run_tables``), and ``run_verdict`` has words about how a run went;
``terminal_output`` prints both. ``page_kit`` has the templates of all pages.
"""
