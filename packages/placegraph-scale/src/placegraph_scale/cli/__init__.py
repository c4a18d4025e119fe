"""Commands of placegraph-scale."""
