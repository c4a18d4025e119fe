"""Scene libraries in shards."""
