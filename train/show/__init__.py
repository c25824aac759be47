"""Drawing from plain data: figures, HTML pages, tables, the report. Imports nothing of the networks or the data."""
