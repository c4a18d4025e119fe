"""Scene graphs that other programs wrote: Hydra's, ConceptGraphs'."""
