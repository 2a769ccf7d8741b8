"""`python -m log2sim` is `log2sim`."""

from log2sim.cli import main

if __name__ == "__main__":
    main()
