"""The learned matcher (Eq. 9-16) in NumPy: graphs, embeddings and the joint model."""
