"""Pictures and pages of cities and of places found."""
