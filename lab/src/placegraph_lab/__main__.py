"""`python -m placegraph_lab`, as `placegraph-lab`."""

from placegraph_lab.cli.lab import main

main()
