"""How well a viewpoint explains what was said.

`query` compiles a description against a city, `statements` has its columns; of the kernels `fit` says
how geometry fits one statement, `match` what all statements say of a viewpoint, `coherence` that a
mention means one thing throughout, `bound` which viewpoints are worth a look, `score` how they score.
"""
