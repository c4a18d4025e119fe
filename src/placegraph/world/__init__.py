"""Cities and rooms together: where scene maps stand in a city, and one answer from both."""
