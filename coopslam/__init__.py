"""A factor-graph SLAM backend for cooperating robots."""
