"""What people see: number formats, tables, figures, report, viewer."""
