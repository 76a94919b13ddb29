"""Moves, free map and explorer: how an unknown world is triangulated."""
