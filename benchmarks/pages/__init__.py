"""Pages whose measured figures come from results files, and the numbers of pages that are no measured figures."""
