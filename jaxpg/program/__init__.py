"""From options to compiled functions."""
