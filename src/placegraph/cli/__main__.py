"""`python -m placegraph.cli`."""

from placegraph.cli import main

if __name__ == "__main__":
    main()
