"""Campaign that tries to break placegraph: fuzzing, faults, endurance, properties, platforms."""
