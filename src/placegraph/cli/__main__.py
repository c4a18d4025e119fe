"""`python -m placegraph.cli`: as `python -m placegraph`."""

from placegraph.cli import main

if __name__ == "__main__":
    main()
