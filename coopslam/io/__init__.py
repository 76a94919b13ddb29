"""Files: run logs, data sets and maps in the formats of the field."""
