"""Building worlds in shards in bounded memory."""
