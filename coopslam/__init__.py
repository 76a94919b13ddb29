"""A factor-graph SLAM backend for cooperating robots."""

__version__ = "0.1.0"
