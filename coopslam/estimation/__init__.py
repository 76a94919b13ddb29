"""From records to estimates."""
