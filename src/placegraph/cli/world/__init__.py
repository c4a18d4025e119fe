"""Commands about worlds in shards."""
