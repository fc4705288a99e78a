"""The commands, those of one subject in a file.

A file has ``app = typer.Typer()`` and a plain function for each command, under ``@app.command()``:
its panel of the help, and examples as the epilog. The options are ``Annotated`` parameters with
their help. What the function returns is the exit status. It imports what is large within itself, so
that help and completion need none of it. The help shows panels in the order of
:data:`cosim.cli.options.PANELS`, within a panel the files by name, then the functions of a file.

The entry points of an extension in the group ``noack.commands`` name modules of the same form.
"""
