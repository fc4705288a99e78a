"""Output for people: number formats, tables, figures, report, viewer."""
