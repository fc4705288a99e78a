"""Output for people: figures, tables, pages, the terminal, the viewer, and exports.

Each analysis builds a ``document`` of sentences, tables (``result_tables``) and figures
(``figures``). ``terminal_writer`` prints it, ``page_kit`` makes a page of it. ``run_document`` is that of
a run, with the rows of ``run_tables`` and the words of ``run_verdict``; ``report_page`` is its page.
"""
