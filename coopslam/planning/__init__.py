"""The dual graph of the map, paths over it, and place recognition."""
