"""Ray casting: one small interface, several engines."""
