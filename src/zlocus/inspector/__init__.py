"""A web page that explains a surface cell by cell: map, match curves, profile and 3-D view."""
