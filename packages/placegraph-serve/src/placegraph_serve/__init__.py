"""A server: maps in a folder answer sentences, pictures and other programs over HTTP."""
