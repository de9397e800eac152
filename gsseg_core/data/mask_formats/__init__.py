"""Masks of other programs: one file per format, behind the table in `table.py`."""
