"""Vectors on a Milvus server."""
