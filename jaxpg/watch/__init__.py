"""Watching policies instead of reading numbers: reports, comparisons and videos."""
