"""Pictures and pages of a map and of an estimate on it."""
