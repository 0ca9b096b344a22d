"""Import cameras of other programs: one module per format, listed in `registry`."""
