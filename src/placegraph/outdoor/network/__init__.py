"""The learned matcher (Eq. 9-16), by NumPy: embeddings of texts and cells, and the joint model.

`labels` has vectors of any word, `graphs` texts and places as graphs, `batches` many of them in padded
arrays, `network` the equations (`GraphTransformer`), `weights` its sizes and numbers; `encoded` is a
city as a network reads it. How it is trained stands in the lab.
"""
