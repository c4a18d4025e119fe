"""The tables by name: what each measures, its options, rows and columns, and the papers' figures."""
