"""Figures, animation and HTML report."""
