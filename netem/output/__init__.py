"""A result as a document of sentences and tables, and its text on a terminal.

``document.py`` says what a result is, ``result_tables.py`` what a table of it is, also as CSV;
``terminal_writer.py`` prints both.
"""
