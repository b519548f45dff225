"""What is made of a result: terminal, tables, figures, report, recording."""
