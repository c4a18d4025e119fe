"""Places: recall, matchers, scale, dialogue, walks."""
