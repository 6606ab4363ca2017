"""From logged runs, states at times, to a field."""
