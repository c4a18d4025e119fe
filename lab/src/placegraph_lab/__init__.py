"""Worlds, trainings, benchmarks and campaigns of placegraph; the library never imports it."""
