"""Rows of the acceptance table (`acceptance.py`), one module per kind of input or question."""
