"""The learned matcher (Eq. 9-19): what it reads, how it is run, how it is trained.

Read: `labels` (vectors of any word), `graphs` and `relations` (texts and places as graphs),
`batches` (many graphs in padded arrays).
Run, by NumPy: `network` (`GraphTransformer`) over the loops of `kernels`, weights from `weights`,
sizes from `shape`; `encoded` is a city as a network reads it.
Train, by PyTorch (extra `learn`): `train` is the one call; `sample` makes descriptions, `pool` adds
what is easily confused with their places, `torch_batches`, `torch_network` and `objective` are the
equations again, `trainer` the optimisation, `checkpoint` what an interrupted training goes on from.
"""
