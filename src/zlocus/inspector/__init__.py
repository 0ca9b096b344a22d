"""The page that explains a surface, cell by cell: map, match curves, profile and relief."""
