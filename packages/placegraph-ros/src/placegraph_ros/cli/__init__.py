"""Commands of placegraph-ros."""
