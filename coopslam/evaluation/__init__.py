"""Errors against truth, consistency, bounds, and comparison of estimators."""
