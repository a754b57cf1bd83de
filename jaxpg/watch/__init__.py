"""Reports, comparisons and videos."""
