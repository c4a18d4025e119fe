"""Commands of placegraph-io."""
