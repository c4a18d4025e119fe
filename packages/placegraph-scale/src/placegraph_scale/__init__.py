"""Worlds in shards, builds in bounded memory, Dask and Milvus."""
